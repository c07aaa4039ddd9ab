"""The closed loop: residual, diagnosis, new model term, held-out error."""

from twin_core.discover.loop import ClosedLoop, close_loop

__all__ = ["ClosedLoop", "close_loop"]
