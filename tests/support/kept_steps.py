"""A sink that keeps the steps of a run."""


class KeptSteps:
    """Keeps them in ``steps``."""

    def __init__(self):
        self.steps = []

    def add(self, step):
        self.steps.append(step)

    def close(self):
        pass
