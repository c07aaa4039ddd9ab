"""The twin from Python: ``import thermal_twin as tt``.

A handful of functions over the framework in ``twin_core``, with data frames in and out, in the channels' own units:

>>> spec = tt.read("sat.yaml")                        # doctest: +SKIP
>>> record = tt.read("january.csv", spec)             # doctest: +SKIP
>>> model = tt.calibrate(spec, record)                # doctest: +SKIP
>>> loop = tt.close_loop(spec, record, holdout=0.3)   # doctest: +SKIP
>>> tt.forecast(loop.model, record, "1d")             # doctest: +SKIP
"""

from thermal_twin.frames import Record
from thermal_twin.reading import read, save
from thermal_twin.work import calibrate, close_loop, forecast, plot, simulate
from twin_core import __version__
from twin_core.calibrate.result import CalibratedModel
from twin_core.closed_loop import ClosedLoop
from twin_core.errors import TwinError
from twin_core.network.spec import TwinSpec

__all__ = [
    "CalibratedModel",
    "ClosedLoop",
    "Record",
    "TwinError",
    "TwinSpec",
    "__version__",
    "calibrate",
    "close_loop",
    "forecast",
    "plot",
    "read",
    "save",
    "simulate",
]
