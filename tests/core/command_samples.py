"""A cell for the commands that redesign: a design's file, scans of its prints, and what the commands leave."""

import json
from functools import cache
from itertools import count
from pathlib import Path

import jsonschema
import numpy as np

from mdf_core.distortion import distortion_left
from mdf_core.ledger import Ledger
from mdf_core.mesh_io import load_design, stl_bytes
from mdf_core.virtual_cell import Printer, ScannerSettings, Warp, build_part, scan_part

# The scans lie where the design lies, and one kernel width is enough for these warps.
POSED = ("--set", "pose.initial=0,0,0,0,0,0,1", "--set", "surface.beta=1.4", "--set", "surface.rank=150")
SCHEMA = json.loads((Path(__file__).parents[2] / "docs/schema/record.schema.json").read_text())
NUMBERS = count()


build = cache(build_part)


class Cell:
    """A design's file, and scans of prints of it or of a redesign."""

    def __init__(self, folder, part="bracket", variation=0.0):
        self.folder = folder
        self.design_path = folder / "part.stl"
        design = build(part)
        self.design_path.write_bytes(stl_bytes(design.vertices, design.faces))
        self.design = load_design(self.design_path, "mm")
        self.printer = Printer(Warp(self.design, 1.5, 50.0, 1), variation=variation)

    def vertices(self, path):
        """Of a redesign, in the design's order."""
        vertices = self.design.vertices.copy()
        vertices[self.design.faces.ravel()] = load_design(path, "mm").triangles.reshape(-1, 3)
        return vertices

    def scan(self, redesign=None, seed=0, **scanner):
        """File with a scan of a print."""
        vertices = self.design.vertices if redesign is None else self.vertices(redesign)
        settings = ScannerSettings(points=6_000, **scanner)
        scan = scan_part(self.printer.print_part(vertices, seed), self.design.faces, settings, seed).scan
        path = self.folder / f"scan{next(NUMBERS)}.npy"
        np.save(path, np.hstack([scan.points, scan.normals]))
        return path

    def left(self, redesign):
        """RMS distortion of the mean print of a redesign, over that of the design."""
        before = distortion_left(self.design, self.printer.print_part(self.design.vertices))[0]
        return distortion_left(self.design, self.printer.print_part(self.vertices(redesign)))[0] / before


def record_of(folder):
    """The record, which keeps to its schema."""
    found = json.loads((folder / "record.json").read_text())
    jsonschema.validate(found, SCHEMA)
    return found


def contents(folder):
    """Of every file in a folder, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def cycles(url):
    with Ledger(url) as ledger:
        return ledger.history()
