"""Settings by names that they had before are refused with those that they have now, and those that are gone with the reason."""

import re

import pytest

from torchtrack.config.components import Component
from torchtrack.config.explain import dotted_keys
from torchtrack.config.fixed import FIXED, SWITCHES
from torchtrack.config.load import load
from torchtrack.config.renamed import KEYS, REMOVED, SECTIONS, no_setting
from torchtrack.config.tracker import TrackerConfig
from torchtrack.errors import ConfigError


@pytest.mark.parametrize(
    ("old", "message"),
    [
        ("search.turns", "search.*: renamed to 'relocalization', 'turns' is now 'rotations'"),
        ("search.hypotheses", "search.*: renamed to 'relocalization'$"),
        ("relocalization.margin", "relocalization.margin .*: renamed to 'relocalization.accept_margin'$"),
        ("relocalization.doubt_us", "renamed to 'relocalization.drift_us', which is a component now: 'disabled: .drift.' switches it off"),
        ("relocalization.stands_from", "renamed to 'relocalization.held_from', which is removed, leave it out: what drifts is looked for farther"),
        ("quality.certain_at", "quality.*: renamed to 'validation', 'certain_at' is fixed at 0.75 now"),
        ("matching.min_observations", "matching.*: renamed to 'association'$"),
    ],
)
def test_a_name_that_a_setting_had_before_is_refused_with_the_name_it_has(old, message):
    with pytest.raises(ConfigError, match=message):
        load(TrackerConfig, overrides={old: 1})


def test_all_the_names_that_settings_have_now_are_settings():
    known = set(dotted_keys(TrackerConfig))
    for section, keys in KEYS.items():
        now = {(SECTIONS.get(section, section), key) for key in keys.values()}
        assert {".".join(place) for place in now if no_setting(place) is None} <= known
        assert not known & {f"{section}.{key}" for key in keys}


def test_settings_that_were_removed_are_refused_with_the_reason():
    for section, keys in REMOVED.items():
        for key, why in keys.items():
            with pytest.raises(ConfigError, match=f"{section}.{key} .*: removed, leave it out: {re.escape(why)}$"):
                load(TrackerConfig, overrides={f"{section}.{key}": 1})


def test_a_setting_that_was_removed_is_none():
    assert not set(dotted_keys(TrackerConfig)) & {f"{section}.{key}" for section, keys in REMOVED.items() for key in keys}


def test_settings_that_are_constants_are_refused_with_the_value():
    for section, keys in FIXED.items():
        for key, value in keys.items():
            with pytest.raises(ConfigError, match=rf"{section}.{key} .*: fixed at {re.escape(value)} now$"):
                load(TrackerConfig, overrides={f"{section}.{key}": 1})


def test_settings_that_are_components_are_refused_with_what_switches_them_off():
    for section, keys in SWITCHES.items():
        for key, component in keys.items():
            with pytest.raises(ConfigError, match=rf"{section}.{key} .*: a component now: 'disabled: \[{component}\]' switches it off$"):
                load(TrackerConfig, overrides={f"{section}.{key}": False})
            assert not load(TrackerConfig, overrides={"disabled": [str(component)]}).uses(component)


def test_every_component_is_used_unless_it_is_disabled():
    assert all(TrackerConfig().uses(component) for component in Component)
    with pytest.raises(ConfigError, match="disabled.*: input should be 'corner_snap', .*got 'corner_snaps'"):
        load(TrackerConfig, overrides={"disabled": ["corner_snaps"]})


def test_what_is_a_constant_or_a_component_is_no_setting():
    gone = {f"{section}.{key}" for table in (FIXED, SWITCHES) for section, keys in table.items() for key in keys}
    assert not set(dotted_keys(TrackerConfig)) & gone
