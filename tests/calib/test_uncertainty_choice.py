"""The rule by which a richer model is believed."""

from __future__ import annotations

import numpy as np
import pytest

from calib.uncertainty_choice import generalises, is_clearly_lower, photos_needed, what_it_brings

SIMPLER = np.array([1.0, 1.2, 0.8, 1.1, 0.9, 1.0])


def test_what_is_lower_by_chance_is_not_clearly_lower(rng):
    assert not is_clearly_lower(SIMPLER - np.array([1.0, -0.9, 1.0, -0.9, 0.9, -0.8]) * 0.3, SIMPLER, 2.0)
    assert is_clearly_lower(SIMPLER - 0.3, SIMPLER, 2.0)


def test_what_is_lower_by_next_to_nothing_is_not_clearly_lower():
    assert not is_clearly_lower(0.97 * SIMPLER, SIMPLER, 1.0)
    assert is_clearly_lower(0.95 * SIMPLER, SIMPLER, 1.0)


def test_a_view_that_is_not_seen_is_worse_than_any_error():
    lost = np.where(np.arange(6) == 2, np.inf, SIMPLER)
    assert not is_clearly_lower(lost, SIMPLER, 1.0)
    assert is_clearly_lower(SIMPLER, lost, 1.0)


@pytest.mark.parametrize(
    ("ratio", "simpler", "believed"),
    [(1.04, 1.01, True), (1.06, 1.01, False), (1.2, 1.03, False), (1.1, 1.17, True), (1.2, 1.19, True)],
)
def test_a_model_generalises_by_itself_or_nearly_as_well_as_the_simpler_one(ratio, simpler, believed):
    assert generalises(ratio, simpler) == believed


def test_photos_that_are_needed_are_about_those_at_which_a_right_model_keeps_to_the_limit():
    shared, coordinates = 155, 2 * 54 - 6
    for count in (10, 14, 20):
        part = shared / (coordinates * count)
        ratio = np.sqrt((1 + part) / (1 - part))
        told = int(photos_needed(count, ratio).split()[1])
        assert told - 10 <= shared / coordinates / 0.0488 <= told


def test_nobody_is_asked_for_a_thousand_photos():
    assert photos_needed(15, 2.5) == "many more photos"


def test_the_sentence_says_what_it_brings_and_what_it_takes():
    told = what_it_brings("a free board shape", (0.1714, 0.0779), "it does not hold", "more photos", "--shape free")
    assert told == (
        "a free board shape would bring the error of photos held out from 0.171 to 0.078 px, but it does not hold: "
        "it needs more photos, or --shape free"
    )


def test_errors_that_differ_are_told_by_digits_that_differ():
    told = what_it_brings("fisheye", (0.01914, 0.01868), "it does not hold", "more photos", "--model fisheye")
    assert "from 0.01914 to 0.01868 px" in told
    assert "from 0.171 to 0.078 px" in what_it_brings("fisheye", (0.1714, 0.0779), "it does not", "more", "--model f")
