"""ROS parameters: every setting under its dotted name, and the parameters of the nodes themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from mdf_core.errors import InvalidSettingError, MdfError, PathNotAllowedError
from mdf_core.geometry import Design
from mdf_core.regions import Region, load_regions
from mdf_core.settings import Settings, leaves

OUTPUT_FOLDER = "mdf_output"
"""Where a cell writes, unless it is told."""


def declare(
    node: Node,
    name: str,
    default: Any,
    description: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] = (),
    read_only: bool = False,
) -> None:
    """Declare one parameter with everything that ``ros2 param describe`` shows; tuples become arrays of doubles.

    Raises
    ------
    InvalidSettingError
        The value given at the start has the wrong type or is outside the range.
    """
    descriptor = ParameterDescriptor(
        description=f"{description} [{unit}]" if unit else description,
        additional_constraints=f"one of {', '.join(choices)}" if choices else "",
        read_only=read_only,
    )
    if minimum is not None or maximum is not None:
        _add_range(descriptor, default, minimum, maximum)
    try:
        if isinstance(default, tuple):
            _declare_numbers(node, name, default, descriptor)
        else:
            node.declare_parameter(name, default, descriptor)
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        raise InvalidSettingError(str(error), f"parameter {name}", "correct it and start the node again") from None


def declare_choice(
    node: Node, name: str, default: str, description: str, choices: Sequence[str], *, read_only: bool = False
) -> None:
    """Declare a parameter that is one of a few words; another one is refused.

    Raises
    ------
    InvalidSettingError
        The value given at the start is none of them.
    """

    def check(parameters: list[Parameter]) -> SetParametersResult:
        for each in parameters:
            if each.name == name and each.value not in choices:
                reason = f"{name}: unknown value {each.value!r}; use one of {', '.join(choices)}"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(check)
    declare(node, name, default, description, choices=choices, read_only=read_only)


def _add_range(descriptor: ParameterDescriptor, default: Any, minimum: float | None, maximum: float | None) -> None:
    if isinstance(default, int):
        descriptor.integer_range = [
            IntegerRange(
                from_value=-(2**63) if minimum is None else int(minimum),
                to_value=2**63 - 1 if maximum is None else int(maximum),
            )
        ]
    else:
        descriptor.floating_point_range = [
            FloatingPointRange(
                from_value=-math.inf if minimum is None else float(minimum),
                to_value=math.inf if maximum is None else float(maximum),
            )
        ]


def _declare_numbers(node: Node, name: str, default: tuple[float, ...], descriptor: ParameterDescriptor) -> None:
    # rclpy takes an empty list for bytes, so the type is told and the default is set afterwards.
    parameter = node.declare_parameter(name, Parameter.Type.DOUBLE_ARRAY, descriptor)
    if parameter.type_ == Parameter.Type.NOT_SET:
        node.set_parameters([Parameter(name, Parameter.Type.DOUBLE_ARRAY, list(default))])


def declare_settings(node: Node) -> None:
    """Declare every leaf of `Settings`; from then on changes are checked as a whole and take effect with the next job.

    Raises
    ------
    InvalidSettingError, UnknownMethodError
        A value given at the start cannot be used.
    """
    for name, leaf, value in leaves(Settings()):
        declare(node, name, value, **leaf.metadata)
    settings_from(node)
    known = Settings().flat()

    def check(parameters: list[Parameter]) -> SetParametersResult:
        changes = {each.name: each.value for each in parameters if each.name in known}
        try:
            settings_from(node).replace(changes)
        except MdfError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def with_typed_lists(parameters: list[Parameter]) -> list[Parameter]:
        # `ros2 param set` and `param load` send an empty list as one of bools.
        return [
            Parameter(each.name, Parameter.Type.DOUBLE_ARRAY, [])
            if isinstance(known.get(each.name), tuple) and each.type_ == Parameter.Type.BOOL_ARRAY and not each.value
            else each
            for each in parameters
        ]

    node.add_pre_set_parameters_callback(with_typed_lists)
    node.add_on_set_parameters_callback(check)


def declare_regions(node: Node) -> None:
    """Declare the parameter that `regions_from` asks."""
    declare(node, "regions_path", "", "YAML file of regions that must not move or have tolerances of their own")


def regions_from(node: Node, design: Design) -> tuple[Region, ...]:
    """The regions of the design, as the file says now.

    Raises
    ------
    InvalidSettingError, DesignFileError
        As `load_regions`.
    """
    path = node.get_parameter("regions_path").value
    return load_regions(path, design) if path else ()


def declare_request_folders(node: Node) -> None:
    """Declare the parameter that `require_allowed` asks."""
    declare(
        node,
        "request_folders",
        "",
        "Folders, separated by colons, that paths in requests must lie in; empty: anywhere",
        read_only=True,
    )


def require_allowed(node: Node, path: str) -> None:
    """Refuse a path of a request that is empty, or outside the folders allowed, wherever links lead.

    Raises
    ------
    InvalidSettingError, PathNotAllowedError
    """
    if not path:
        raise InvalidSettingError("no path is given", "path", "name the file")
    folders = [Path(folder).resolve() for folder in node.get_parameter("request_folders").value.split(":") if folder]
    if folders and not any(Path(path).resolve().is_relative_to(folder) for folder in folders):
        allowed = ", ".join(map(str, folders))
        raise PathNotAllowedError("lies outside the folders for requests", path, f"put the file into {allowed}")


def settings_from(node: Node) -> Settings:
    """The settings that the parameters hold now.

    Raises
    ------
    InvalidSettingError, UnknownMethodError
        A value that cannot be used.
    """
    return Settings().replace({name: node.get_parameter(name).value for name in Settings().flat()})
