"""What of a record is no reading, found before anything is fitted to it."""

from twin_core.quality.screen import Screening, masked, screen, unmasked
from twin_core.quality.summary import quality_json, quality_strip

__all__ = ["Screening", "masked", "quality_json", "quality_strip", "screen", "unmasked"]
