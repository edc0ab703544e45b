"""Installed message types by name, and their definitions as bags carry them."""

from __future__ import annotations

import importlib
import json
import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mdf_core.errors import BagTopicError

_SEPARATOR = "=" * 80


@dataclass(frozen=True)
class MessageDefinition:
    """What a bag says about a message type.

    Attributes
    ----------
    text : str
        The .msg file, followed by those of all types it is made of (schema encoding ``ros2msg``).
    type_hash : str
        RIHS01 hash of the type.
    """

    text: str
    type_hash: str


def message_class(type_name: str) -> Any:
    """The Python class of ``package/msg/Type``.

    Raises
    ------
    BagTopicError
        The type is not installed.
    """
    try:
        # Bags come from anywhere: only a message may be imported, not whatever module a bag names.
        if not _share_file(type_name, "msg").is_file():
            raise _not_installed(type_name)
        package, group, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.{group}"), name)
    except (ValueError, ImportError, AttributeError):
        raise _not_installed(type_name) from None


def message_definition(type_name: str) -> MessageDefinition:
    """The definition of ``package/msg/Type`` with everything it depends on.

    Raises
    ------
    BagTopicError
        The type is not installed.
    """
    try:
        description = json.loads(_share_file(type_name, "json").read_bytes())
        hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}
        needed = [entry["type_name"] for entry in description["type_description_msg"]["referenced_type_descriptions"]]
        text = _share_file(type_name, "msg").read_text()
        for name in needed:
            package, _, short_name = name.split("/")
            text += f"\n{_SEPARATOR}\nMSG: {package}/{short_name}\n{_share_file(name, 'msg').read_text()}"
    except (ValueError, OSError):
        raise _not_installed(type_name) from None
    return MessageDefinition(text, hashes[type_name])


def _share_file(type_name: str, suffix: str) -> Path:
    """The installed interface file; in the environment of this Python where ROS came as wheels."""
    package, group, name = type_name.split("/")
    prefixes = [*filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)), sys.prefix]
    places = [Path(prefix) / "share" / package / group / f"{name}.{suffix}" for prefix in prefixes]
    return next((place for place in places if place.is_file()), places[-1])


def _not_installed(type_name: str) -> BagTopicError:
    return BagTopicError(
        f"message type {type_name} is not installed", "", f"install or source package {type_name.partition('/')[0]}"
    )
