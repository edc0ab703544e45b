"""The page of the closed loop, and its picture."""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.cases import NOISES_MM, WARP_LENGTHS_MM, WARP_MM
from bench.closed_loop.loops import METHODS, OURS, PAPER, Loop
from bench.closed_loop.plan import DENSER, HIDDEN, Plan
from bench.closed_loop.tables import (
    Fates,
    Results,
    estimates_seen,
    estimates_table,
    figures,
    hidden_table,
    kept,
    method_table,
    methods_seen,
    noise_table,
    points_table,
    prints_table,
    unmoved,
    wrong_seen,
    wrong_table,
)
from bench.closed_loop.wrong import TOLERANCE_MM, other_part
from bench.paper import part as paper
from mdf_core.settings import Settings

_DOTS_PER_INCH = 80
_LINE_STYLES = ("-", "--", ":")


def picture(plan: Plan, results: Results) -> bytes:
    """PNG of what is left against the cycle: of every method, and of ours for every number of prints."""
    figure = Figure(figsize=(12.0, 5.0), layout="constrained")
    methods, prints = figure.subplots(1, 2, sharey=True)
    for number, name in enumerate(METHODS):
        loops = plan.loops_of(name)
        _draw(methods, results, loops, label=name, color=f"C{number}", linewidth=2.5 if name == OURS else 1.2)
    methods.axhline(1.0, color="0.5", linestyle=":", label="no compensation")
    for row, (variation, count) in zip(plan.by_prints, plan.repeated, strict=True):
        style = _LINE_STYLES[plan.variations.index(variation) % len(_LINE_STYLES)]
        colour = f"C{plan.prints.index(count)}"
        label = f"variation {variation:g}, prints {count}"
        _draw(prints, results, row.loops, label=label, color=colour, linestyle=style)
    for axes, title in ((methods, "methods, one print, no variation"), (prints, "ours, prints per cycle")):
        axes.set(yscale="log", xlabel="cycle", title=title, xticks=range(plan.cycles + 1))
        axes.grid(which="major", alpha=0.4)
        axes.grid(which="minor", alpha=0.15)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, frameon=False, fontsize="small")
    methods.set_ylabel("share of the distortion that is left")
    image = io.BytesIO()
    figure.savefig(image, dpi=_DOTS_PER_INCH, format="png")
    return image.getvalue()


def _draw(axes: Axes, results: Results, loops: Sequence[Loop], **style: Any) -> None:
    """The mean of the loops from cycle to cycle, and between which bounds they lie."""
    cycles = [np.ones(1), *(figures(results, loops, number) for number in range(loops[0].cycles))]
    cycles = [values for values in cycles if len(values)]
    numbers = range(len(cycles))
    axes.plot(numbers, [values.mean() for values in cycles], marker="o", markersize=4, **style)
    least, most = [values.min() for values in cycles], [values.max() for values in cycles]
    axes.fill_between(numbers, least, most, color=style["color"], alpha=0.1, linewidth=0)


def page(plan: Plan, results: Results, fates: Fates, picture_name: str, made: str) -> str:
    beyond, moved = unmoved(results, plan.by_hidden)
    mixture = paper.PAPER.mixture
    return f"""\
# The closed loop

A virtual printer warps every part by up to {WARP_MM:g} mm ({WARP_LENGTHS_MM[0]:g} mm correlation length); a virtual
scanner sees {plan.points:,} points of every print with {1e3 * NOISES_MM[1]:g} µm noise and 1 % outliers. Print, scan,
inspect, redesign, print the redesign, and so on; what is left counts, not the time.

- **left**: RMS distortion of the printer's mean print of the redesign over that of its mean print of the design, both
  after the best rigid fit: 1 nothing gained, 0 all gone. **largest**: the same of the largest distance of a vertex.
- **variation** from print to print, relative to the distortion; other smooth waves in every print.
- Numbers are means over the seeds ({plan.seeds}: another warp, other prints and scans each) and over the parts where a
  table does not name them, with the least and the most in brackets.
- Every scan lies anywhere, and every method is told its true pose: the loop is measured and not the pose search.
- Printers: *spatial* distorts places in its space, *material* places of the part.

![what is left against the cycle]({picture_name})

## Which method

One print per cycle, no variation. Two cycles are enough to see how the others go on.

- **nearest point**: every vertex is moved by minus the vector to the scan point nearest to it, whichever that is.
- **CPD, subtracted**: plain coherent point drift; its displacement at the vertices is subtracted.
- **{PAPER}**: the paper's pipeline with its parameters (boxes of {paper.BOX_MM:g} mm, β = {mixture.beta:g},
  α = {mixture.alpha:g}, w = {mixture.outlier_share:g}), C = X + u(X). CPD has the same parameters and points.
- **ours**: the defaults, with `compensation.lookup` as the printer is.

{method_table(plan, results)}
Left over all parts, printers and seeds:

{methods_seen(plan, results)}

What a mixture misses lies along the faces, where nothing holds its points; it does not shrink with the distortion, and
further cycles add it up. The nearest point says nothing of a displacement along the face, and the gaps between the scan
points come on top. What ours leaves after one cycle is mostly smaller than the standard error of the next measurement:
without variation more cycles cost prints and gain little.

## How dense a scan

Spatial printer, one cycle. The paper's own scan is denser than {plan.points:,} points, so here is one of
{DENSER * plan.points:,} for everyone, too.

{points_table(plan, results)}
## How many prints, how many cycles

Ours, spatial printer. In every cycle so many prints are made of one mesh and inspected together. The mean of n prints
is off by variation / √n, and that is what can be expected to be left after the first cycle.

{prints_table(plan, results)}
{kept(results, [loop for row in plan.by_prints for loop in row.loops])}
A cycle weighs its own prints against those of the cycles before, so that what is left falls with the number of all
prints, not only with those of one cycle. The variation it learns from what several prints have apart, or from how far a
single one is from what the prints before foretold. Without variation more prints gain less than 1 / √n: part of the
error is that of the registration itself, the same in every scan.

### What the library says itself

Predicted residual and variation of the redesign, relative to the distortion, beside what is left:

{estimates_table(plan, results)}
{estimates_seen(plan, results)}

The first print alone cannot show the variation, and what is predicted from it leaves it out. From the second one on it
counts, as the standard error of their mean.

## Noise of the scanner

Ours, spatial printer, one print per cycle, no variation.

{noise_table(plan, results)}
## A hidden side

Ours, spatial printer, one print per cycle, no variation; {HIDDEN:.0%} of the surface, the same side in every cycle,
is never seen. **seen**: over what the first scan supports. **beyond the blend**: vertices farther than
{Settings().compensation.blend_mm:g} mm from any supported one, over all cycles and seeds; they must not move.

{hidden_table(plan, results)}
Of {beyond:,} vertices beyond the blend {moved:,} were moved. They keep their distortion; nearer ones, as on the other
side of a thin wall, follow what is seen in part. That is most of what is left.

## What must not get through

The scan of a first print, given wrongly, to ours, with the checks of a scan that the cell makes before a redesign. The
tolerance is {TOLERANCE_MM:g} mm, so that what is measured right passes. Another part is
{", ".join(f"the {other_part(part)} for the {part}" for part in fates)}.

{wrong_table(fates)}
{wrong_seen(fates)}

{made}
"""
