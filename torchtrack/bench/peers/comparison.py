"""What is gathered while ours and others are measured side by side."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from torchtrack.bench.plots import Plot
from torchtrack.bench.results import Result, time_result
from torchtrack.bench.setup import Setup

Work = Callable[[], Any]


@dataclass
class Comparison:
    """Figures so far.

    Args:
        setup: how to measure.
        results, notes, plots: as of a report.
    """

    setup: Setup
    results: list[Result] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)

    def prepare(self, name: str, package: str, make: Callable[[], Work]) -> Work | None:
        """The work of a peer; None, and a note, where its library is missing here.

        Args:
            name: of the peer.
            package: what pip installs it by.
            make: imports the library and makes the work.
        """
        try:
            with warnings.catch_warnings():
                # What a library has to say about itself when it is imported is nothing that our users can change.
                warnings.simplefilter("ignore")
                return make()
        except (ImportError, AttributeError) as error:
            note = f"{name}: not measured, as it is not installed ({error}): pip install {package}"
            if note not in self.notes:
                self.notes.append(note)
            return None

    def time(self, name: str, work: Work) -> Result:
        """Time it, and keep the figures."""
        self.setup.show(name)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            result = time_result(name, self.setup.clock.seconds(work, self.setup.repeats))
        self.results.append(result)
        return result

    def ahead(self, peer: Result, ours: Result, target: float | None = None) -> None:
        """Keep how many times faster ours is."""
        ratios = tuple(theirs / mine for theirs, mine in zip(peer.figures, ours.figures, strict=True))
        self.results.append(Result(f"{peer.name}, over ours", "times", ratios, target))
