"""Trackers of these tests take no look before a pose is confirmed, but where that is looked at: it takes as long as all the rest of a test."""

import pytest

from torchtrack.config.components import Component
from torchtrack.config.tracker import TrackerConfig

# Folders whose tests are of that look, or of what hangs on it.
_WITH_IT = {"relocalization", "validation"}


@pytest.fixture(autouse=True, scope="module")
def no_look_before_confirmation(request):
    """Leaves out :attr:`Component.UNCONFIRMED`, for fixtures of a module too."""
    if request.path.parent.name in _WITH_IT:
        yield
        return
    uses = TrackerConfig.uses
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrackerConfig, "uses", lambda config, component: component != Component.UNCONFIRMED and uses(config, component))
        yield
