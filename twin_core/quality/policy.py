"""How sure the screening must be before it calls a sample no reading: probabilities, and where they come from."""

FALSE_ALARM_RATE = 1e-3
"""Tolerated probability that a healthy channel loses anything in one record. A record has a dozen channels, a project some
hundred records: about one false alarm in all of them."""

LONGEST_SPIKE = 3
"""Readings in a row that a spike may last: bit errors and dropouts touch a frame or two. What lasts longer is an event."""

LEAST_READINGS = 16
"""Fewer readings show no habits that something could break with."""

COLDEST_K = 1.0
"""No thermometer of a spacecraft reads less: 0 K is a missing value, however long it lasts."""

MARKERS = (-32768.0, -9999.0, -999.9, -999.0, 9999.0, 32767.0, 65535.0, 99999.0)
"""Numbers that loggers write for 'missing', in a channel's own unit: strings of nines, full-scale integers of 16 bits. A
number counts as a marker only where the readings leap to it and back as they never do elsewhere."""

TEMPERATURE_MARKERS = (*MARKERS, -127.0, 0.0, 85.0, 999.0, 999.9, 4095.0)
"""Of temperatures also zero, and the -127 and 85 degC of digital thermometers that are not there or not ready. A heater may
well be switched on once, at 85 W."""
