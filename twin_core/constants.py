"""Physical constants, each with its source."""

STEFAN_BOLTZMANN_W_PER_M2_K4 = 5.670374419e-8
"""CODATA 2018, exact to the digits given."""

ZERO_CELSIUS_K = 273.15
"""Definition of the degree Celsius (BIPM SI brochure, 9th edition)."""

SOLAR_CONSTANT_W_PER_M2 = 1361.0
"""Total solar irradiance at 1 AU (Kopp and Lean 2011, doi:10.1029/2010GL045777)."""

ASTRONOMICAL_UNIT_M = 149_597_870_700.0
"""IAU 2012 resolution B2."""

EARTH_RADIUS_M = 6_378_137.0
"""WGS 84 equatorial radius."""

EARTH_GM_M3_PER_S2 = 3.986004418e14
"""WGS 84 geocentric gravitational constant."""

DEEP_SPACE_K = 2.725
"""Cosmic microwave background (Fixsen 2009, doi:10.1088/0004-637X/707/2/916)."""
