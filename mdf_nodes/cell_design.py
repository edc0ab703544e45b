"""The design of the cell: which one the parameters or the journal name, and the mesh that a node works on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from rclpy.node import Node

from mdf_core.errors import NoDesignError
from mdf_core.geometry import Design
from mdf_core.mesh_io import load_design
from mdf_core.units import UNITS
from mdf_nodes.journal import DesignChoice, Journal
from mdf_nodes.managed_node import ManagedNode
from mdf_nodes.parameters import declare, declare_choice, declare_regions, regions_from, settings_from


@dataclass(frozen=True, eq=False)
class CellDesign:
    """A design that is loaded.

    Attributes
    ----------
    design : Design
        As fine as the settings want it; its path is absolute: every node of the cell has to find it.
    unit : str
        Of the file.
    part_id : str
        Name of the part.
    """

    design: Design
    unit: str
    part_id: str

    @property
    def choice(self) -> DesignChoice:
        """What names it."""
        return DesignChoice(self.design.path, self.unit, self.part_id)

    def is_named_by(self, choice: DesignChoice) -> bool:
        """Whether it is what `load_cell_design` would make of the choice."""
        return self.choice == DesignChoice(choice.path, choice.unit, _part_of(choice))


def declare_design(node: Node) -> None:
    """Declare the parameters of the design and its regions."""
    declare(node, "design_path", "", "Design file, loaded by configure; empty: wait until set_design names one")
    declare_choice(node, "design_unit", "mm", "Unit of the design file", UNITS)
    declare(node, "part_id", "", "Name of the part in results; empty: the design file's name")
    declare(node, "design_frame", "design", "Frame of the results: the origin of the design file")
    declare_regions(node)


def configured_choice(node: Node) -> DesignChoice:
    """The design that the node's parameters name."""
    path, unit, part_id = (node.get_parameter(name).value for name in ("design_path", "design_unit", "part_id"))
    return DesignChoice(str(Path(path).absolute()) if path else "", unit, part_id)


def load_configured_design(node: ManagedNode, journal: Journal) -> CellDesign | None:
    """Load the design that was set by service, or else that of the parameters.

    Returns
    -------
    CellDesign, or None
        None: there is none, or the one that was set by service cannot be loaded any more; this is reported.

    Raises
    ------
    MdfError
        That of the parameters cannot be loaded.
    """
    configured = configured_choice(node)
    chosen = journal.design(configured)
    if not chosen.path:
        return None
    if chosen == configured:
        return load_cell_design(node, chosen)
    # What was set by service can be set again, but only of a node that is active.
    with node.error_boundary():
        return load_cell_design(node, chosen)
    return None


def load_cell_design(node: Node, choice: DesignChoice) -> CellDesign:
    """Load a design, and look whether its regions can be found.

    Raises
    ------
    DesignFileError, InvalidSettingError
        Design or regions cannot be used.
    """
    longest_edge_mm = settings_from(node).design.longest_edge_mm
    design = load_design(Path(choice.path).absolute(), choice.unit, longest_edge_mm=longest_edge_mm)
    regions_from(node, design)  # whatever is wrong with the file shows now
    node.get_logger().info(f"design {choice.path}: {len(design.vertices)} vertices, {len(design.faces)} faces")
    return CellDesign(design, choice.unit, _part_of(choice))


def _part_of(choice: DesignChoice) -> str:
    return choice.part_id or Path(choice.path).stem


def no_design(node: Node) -> NoDesignError:
    """What is raised while there is none."""
    return NoDesignError("no design is set", node.get_name(), "set the parameter design_path, or call set_design")
