"""Work that can wait until those who wait for the results have them, and work in small steps."""

from rclpy.clock import Clock, ClockType


class Later:
    """Calls a function once, a while after it was asked to; meanwhile the node sleeps.

    What a node does at once behind its publishing takes a core from those that it has just
    woken, if there are few.
    """

    def __init__(self, node, delay_s, call):
        self._call = call
        # Not that of a recording, which may stand still.
        self._timer = node.create_timer(delay_s, self._due, autostart=False,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))

    def ask(self):
        """Have it called; who has asked already waits no longer for that."""
        if self._timer.is_canceled():
            self._timer.reset()

    def _due(self):
        """Call it, once."""
        self._timer.cancel()
        self._call()


class Turns:
    """Goes on with long work a step at a time: where there is room for one, or when it is time to.

    There is at most one step each `tick` of a clock. Who finds that nobody waits for anything
    takes it; where nobody has for `patience` ticks, the clock does.
    """

    def __init__(self, steps, patience):
        """`steps` is an endless iterator."""
        self._steps, self._patience = steps, patience
        self._is_due, self._in_vain = False, 0

    def begin(self, steps):
        """Other work from now on."""
        self._steps = steps

    def tick(self):
        """Another step may be taken."""
        self._is_due, self._in_vain = True, self._in_vain + 1
        if self._in_vain > self._patience:
            self._step()

    def take(self):
        """Take a step, if there may be one."""
        if self._is_due:
            self._in_vain = 0
            self._step()

    def _step(self):
        """The next."""
        self._is_due = False
        next(self._steps)
