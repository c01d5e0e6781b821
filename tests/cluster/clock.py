"""A clock for tests: patience that only looks use up, however long the machine takes."""


class Steps:
    """Stands for the module ``time``; goes on only while somebody sleeps by it, who does not sleep then."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds
