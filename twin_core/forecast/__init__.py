"""The forecast: what the sensors will read, from the assimilated state, with inputs as planned or as they use to be.

``period`` looks for a channel's own period, ``assumed`` says how inputs without a plan go on, ``past`` what that missed
before, ``bands`` makes quantiles and the band that holds a whole path of it, ``ahead`` puts it together.
"""

from twin_core.forecast.ahead import MAX_POINTS, WHOLE, Forecast, forecast
from twin_core.forecast.assumed import Inputs, own_times_s

__all__ = ["MAX_POINTS", "WHOLE", "Forecast", "Inputs", "forecast", "own_times_s"]
