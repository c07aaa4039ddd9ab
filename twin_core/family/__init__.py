"""What spacecraft of one design share: parameters learned from all of them, which each one's own telemetry corrects."""

from twin_core.family.pool import Family, Member, pool
from twin_core.family.prior import declared

__all__ = ["Family", "Member", "declared", "pool"]
