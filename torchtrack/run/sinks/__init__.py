"""Where the results of a run go. Each sink takes one step at a time and finishes its files when it is closed."""

from typing import Protocol, runtime_checkable

from torchtrack.run.stepping import Step


@runtime_checkable
class Sink(Protocol):
    """Something that takes the steps of a run one by one."""

    def add(self, step: Step) -> None:
        """Take one step."""
        ...

    def close(self) -> None:
        """Finish: called once, after the last step."""
        ...
