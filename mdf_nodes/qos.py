"""The QoS of the cell's topics, of recorders and of players."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import yaml
from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSPolicyEnum,
    QoSProfile,
    ReliabilityPolicy,
)

SENSOR = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=5,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
"""What scanner drivers offer: sensor data. A subscription with it matches every publisher, reliable ones too, but
loses most messages of tens of MB; where publishers offer more, ask for it with `subscription_profile`."""

SCAN = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=2,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Scans on their way through the cell: none lost, late subscribers get the last ones. Depth 1 would drop a large scan
that is still being sent when the next one comes; more depth costs as many times the largest scan in memory."""

POSES = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""Poses of the views of a scan: none lost."""

LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Designs and results: late subscribers get the latest one and nothing older."""

REQUESTS = QoSProfile(
    history=HistoryPolicy.KEEP_ALL,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
"""What a service asks for: every request waits for its turn. With the usual depth of 10 those of many clients at once
replace each other, and who sent them is never answered."""

_POLICIES: dict[str, type[QoSPolicyEnum]] = {
    "history": HistoryPolicy,
    "reliability": ReliabilityPolicy,
    "durability": DurabilityPolicy,
    "liveliness": LivelinessPolicy,
}
_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")
_NANOSECONDS = 10**9


def subscription_profile(offered: Sequence[QoSProfile], depth: int) -> QoSProfile:
    """The strongest profile that matches all publishers of a topic, whose `offered` profiles discovery tells."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=_all_or(offered, "reliability", ReliabilityPolicy.RELIABLE, ReliabilityPolicy.BEST_EFFORT),
        durability=_all_or(offered, "durability", DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE),
    )


def replay_profile(recorded: Sequence[QoSProfile], depth: int) -> QoSProfile:
    """The profile that matches every subscriber of the `recorded` publishers: as strong as the strongest of them.

    History and depth are not part of it, because discovery, and so the bag, does not know them.
    """
    profile = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth)
    if any(each.reliability == ReliabilityPolicy.BEST_EFFORT for each in recorded) and not any(
        each.reliability == ReliabilityPolicy.RELIABLE for each in recorded
    ):
        profile.reliability = ReliabilityPolicy.BEST_EFFORT
    if any(each.durability == DurabilityPolicy.TRANSIENT_LOCAL for each in recorded):
        profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def _all_or(offered: Sequence[QoSProfile], policy: str, strong: QoSPolicyEnum, weak: QoSPolicyEnum) -> Any:
    return strong if all(getattr(each, policy) == strong for each in offered) else weak


def to_rosbag2(profiles: Iterable[QoSProfile]) -> list[dict[str, Any]]:
    """Profiles as rosbag2 lists them in metadata.yaml (version 9) and, as YAML text, in an MCAP channel."""
    return [
        {
            "history": profile.history.short_key,
            "depth": profile.depth,
            "reliability": profile.reliability.short_key,
            "durability": profile.durability.short_key,
            "deadline": _time(profile.deadline),
            "lifespan": _time(profile.lifespan),
            "liveliness": profile.liveliness.short_key,
            "liveliness_lease_duration": _time(profile.liveliness_lease_duration),
            "avoid_ros_namespace_conventions": bool(profile.avoid_ros_namespace_conventions),
        }
        for profile in profiles
    ]


def from_rosbag2(text: str) -> list[QoSProfile]:
    """Profiles from the YAML of rosbag2: policies by name or, before version 9, by number.

    Raises
    ------
    ValueError
        Not such a list.
    """
    try:
        return [_profile(entry) for entry in yaml.safe_load(text) or []]
    except (yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"no QoS profiles of rosbag2: {error!r}") from None


def _profile(entry: dict[str, Any]) -> QoSProfile:
    policies = {
        name: policy(entry[name]) if isinstance(entry[name], int) else policy[entry[name].upper()]
        for name, policy in _POLICIES.items()
    }
    durations = {
        name: Duration(nanoseconds=entry[name]["sec"] * _NANOSECONDS + entry[name]["nsec"]) for name in _DURATIONS
    }
    return QoSProfile(
        depth=entry["depth"],
        avoid_ros_namespace_conventions=entry["avoid_ros_namespace_conventions"],
        **policies,
        **durations,
    )


def _time(duration: Duration) -> dict[str, int]:
    seconds, nanoseconds = divmod(duration.nanoseconds, _NANOSECONDS)
    return {"sec": seconds, "nsec": nanoseconds}
