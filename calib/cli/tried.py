"""Remedies that know what was tried: a model that the automatic choice has just refused is no advice."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from calib.diagnose import Finding
from calib.uncertainty_lenses import RankedLens
from calib.uncertainty_shapes import CANDIDATES, RankedShape
from calib.yardstick import Yardstick


def with_what_was_tried(
    findings: Sequence[Finding], lenses: Sequence[RankedLens], shapes: Sequence[RankedShape]
) -> tuple[Finding, ...]:
    """The findings; where a richer model was tried and not taken their remedies say why, and what is left to do.

    Args:
        lenses, shapes: ranked, the chosen one first; empty where it was given.
    """
    remedies = {"bent_board": _of_board(shapes), "lens_model": _of_lens(lenses)}
    return tuple(
        dataclasses.replace(finding, remedy=remedy) if (remedy := remedies.get(finding.cause)) else finding
        for finding in findings
    )


def with_what_was_measured(findings: Sequence[Finding], measured: Yardstick) -> tuple[Finding, ...]:
    """The findings; what is the same wherever in the image it is seen may be the board, which a splined lens tells."""
    remedy = (
        "compare richer lens models with --shape free: the board hides what they bring"
        if measured.is_lens and measured.shape == "free"
        else "try a richer lens model"
        if measured.is_lens
        else "look for what shifts corners (a bend, blur, glare): a splined lens predicts photos held out no better"
    )
    return tuple(
        dataclasses.replace(finding, remedy=remedy) if finding.cause == "lens_model" else finding
        for finding in findings
    )


def _of_board(shapes: Sequence[RankedShape]) -> str:
    if not shapes:
        return ""
    richer = [row for row in shapes[1:] if CANDIDATES.index(row.kind) > CANDIDATES.index(shapes[0].kind)]
    if not richer:
        return "glue the board to glass, and calibrate anew"
    told = "; ".join(f"{row.kind}: {row.refused or 'no better on photos held out'}" for row in richer)
    return f"glue the board to glass, or take more photos: richer shapes were tried and not taken ({told})"


def _of_lens(lenses: Sequence[RankedLens]) -> str:
    if not lenses:
        return ""
    richer = [row for row in lenses[1:] if row.coefficients > lenses[0].coefficients and not row.refused]
    if not richer:
        return "no richer lens model was tried: try --model opencv12; or look for what shifts corners, a bend or glare"
    best = min(richer, key=lambda row: row.held_out_rms_px if math.isfinite(row.held_out_rms_px) else math.inf)
    if best.would_bring:
        return f"richer lens models were tried: {best.would_bring}"
    return (
        f"look for what shifts corners (a bend, blur, glare), or take more photos: richer lens models were tried and "
        f"are no better on photos held out ({best.lens}: {best.held_out_rms_px:.3f} px, "
        f"{lenses[0].lens}: {lenses[0].held_out_rms_px:.3f} px)"
    )
