from __future__ import annotations

import numpy as np
import pytest

from sfm.core.optim import evaluate_loss
from sfm.core.optim._loss_kernels import loss_and_weight
from sfm.core.optim.losses import loss_id

LOSSES = ("trivial", "huber", "soft_l1", "cauchy", "tukey", "truncated")
SQUARED = np.concatenate([[0.0], np.logspace(-6, 6, 60)])


def written_out(loss: str, s: float, a: float) -> float:
    r = np.sqrt(s) / a
    by_loss = {
        "trivial": r * r,
        "huber": r * r if r <= 1 else 2 * r - 1,
        "soft_l1": 2 * (np.hypot(1, r) - 1),
        "cauchy": np.log(1 + r * r),
        "tukey": (1 - (1 - r * r) ** 3) / 3 if r <= 1 else 1 / 3,
        "truncated": min(r * r, 1.0),
    }
    return a * a * by_loss[loss]


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
def test_losses_equal_their_formulas(loss, scale):
    rho, _ = evaluate_loss(loss, SQUARED, scale)
    expected = [written_out(loss, s, scale) for s in SQUARED]
    np.testing.assert_allclose(rho, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("scale", [0.3, 1.0, 4.0])
def test_the_weight_is_the_derivative(loss, scale):
    s = SQUARED[1:]
    h = 1e-4 * s
    _, weight = evaluate_loss(loss, s, scale)
    numeric = (evaluate_loss(loss, s + h, scale)[0] - evaluate_loss(loss, s - h, scale)[0]) / (2 * h)
    np.testing.assert_allclose(weight, numeric, rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_start_as_the_square_and_never_exceed_it(loss):
    rho, weight = evaluate_loss(loss, SQUARED)
    assert rho[0] == 0
    assert weight[0] == 1
    assert np.all(rho <= SQUARED * (1 + 1e-12))
    assert np.all(np.diff(weight) <= 1e-15)


@pytest.mark.parametrize("loss", LOSSES)
@pytest.mark.parametrize("scale", [1e3, 1e6, 1e8])
def test_far_below_their_scale_losses_are_the_square_to_the_last_digits(loss, scale):
    for s in (1e-6, 0.1, 7.0):
        x = s / scale**2
        first_terms = {"soft_l1": 1 - x / 4, "cauchy": 1 - x / 2, "tukey": 1 - x}
        expected = s * first_terms.get(loss, 1.0)
        assert loss_and_weight(loss_id(loss), scale, s)[0] == pytest.approx(expected, rel=1e-10)
        assert float(evaluate_loss(loss, np.array(s), scale)[0]) == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("loss", LOSSES)
def test_losses_of_infinite_residuals_are_numbers_or_infinite(loss):
    rho, weight = loss_and_weight(loss_id(loss), 2.0, np.inf)
    expected = {"tukey": 4 / 3, "truncated": 4.0}.get(loss, np.inf)
    assert rho == pytest.approx(expected)
    assert weight == (1 if loss == "trivial" else 0)
    assert evaluate_loss(loss, np.array(np.inf), 2.0)[0] == pytest.approx(expected)


@pytest.mark.parametrize("loss", LOSSES)
def test_the_kernel_equals_the_arrays(loss):
    for s in SQUARED:
        rho, weight = evaluate_loss(loss, np.array(s), 2.0)
        assert rho.shape == ()
        np.testing.assert_allclose((rho, weight), loss_and_weight(loss_id(loss), 2.0, s), rtol=1e-9, atol=1e-15)


def test_an_unknown_loss_is_named():
    with pytest.raises(ValueError, match="tukee"):
        loss_id("tukee")
