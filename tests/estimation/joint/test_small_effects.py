"""Small errors of the readings as random effects, against dense algebra."""

import numpy as np
import pytest

from meshskin.estimation.joint.small_effects import DEVIATIONS, PARTS, SmallEffects, most_likely

READINGS, EFFECTS = 60, 5


def made(blocks, has, deviation, seed=0):
    """Slopes and information of `blocks` blocks of effects in readings of unit noise, of which the
    first `has` have effects; the effects (b, q), derivatives (b, k, q) and readings (b, k)."""
    rng = np.random.default_rng(seed)
    columns = 30 * rng.normal(size=(blocks, READINGS, EFFECTS))
    effects = deviation * rng.normal(size=(blocks, EFFECTS)) * (np.arange(blocks) < has)[:, None]
    level = np.einsum("bkq,bq->bk", columns, effects) + rng.normal(size=(blocks, READINGS))
    slope = np.einsum("bkq,bk->bq", columns, level)
    return slope, np.swapaxes(columns, 1, 2) @ columns, effects, columns, level


def log_odds(columns, level, deviation):
    """Logarithm of the likelihood of readings (k,) with effects of this deviation, less that
    without."""
    covariance = np.eye(len(level)) + deviation**2 * columns @ columns.T
    with_ = np.linalg.slogdet(covariance)[1] + level @ np.linalg.solve(covariance, level)
    return (level @ level - with_) / 2


def test_one_block_has_the_variance_of_the_largest_marginal_likelihood():
    slope, information, _, columns, level = made(1, 1, 0.02)
    score, mean, covariance = most_likely(slope, information)
    gains = [log_odds(columns[0], level[0], deviation) for deviation in DEVIATIONS]
    assert score == pytest.approx((2 * max(gains)) ** 0.5, rel=1e-6)
    best = DEVIATIONS[int(np.argmax(gains))]
    expected = np.linalg.inv(information[0] + np.eye(EFFECTS) / best**2)
    np.testing.assert_allclose(covariance[0], expected, rtol=1e-6)
    np.testing.assert_allclose(mean[0], expected @ slope[0], rtol=1e-6)


def test_blocks_without_effects_keep_none():
    """The mean and covariance are those of a mixture, by its odds."""
    slope, information, _, columns, level = made(40, 3, 0.02)
    score, mean, covariance = most_likely(slope, information)
    part = np.geomspace(0.5 / 40, 1 - 1e-9, PARTS)
    odds = np.array(
        [[log_odds(c, y, d) for c, y in zip(columns, level, strict=True)] for d in DEVIATIONS]
    )
    total = np.logaddexp(np.log(1 - part)[:, None, None], np.log(part)[:, None, None] + odds)
    i, j = np.unravel_index(np.argmax(total.sum(axis=2)), total.shape[:2])
    assert score == pytest.approx((2 * total[i, j].sum()) ** 0.5, rel=1e-6)
    has = np.exp(np.log(part[i]) + odds[j] - total[i, j])
    assert has[:3].min() > 0.99 > 0.5 > has[3:].max()
    for k in range(40):
        own = np.linalg.inv(information[k] + np.eye(EFFECTS) / DEVIATIONS[j] ** 2)
        centre = own @ slope[k]
        np.testing.assert_allclose(mean[k], has[k] * centre, rtol=1e-5, atol=1e-12)
        expected = has[k] * own + has[k] * (1 - has[k]) * np.outer(centre, centre)
        np.testing.assert_allclose(covariance[k], expected, rtol=1e-5, atol=1e-12)


def test_covariances_hold():
    """Sums of squared errors are those that the covariances state, over blocks with effects that
    are found, are missed, and have none."""
    square = stated = 0.0
    for seed in range(30):
        slope, information, effects, *_ = made(40, 8, 0.01, seed)
        _, mean, covariance = most_likely(slope, information)
        square += float(np.sum((effects - mean) ** 2))
        stated += float(np.trace(covariance, axis1=1, axis2=2).sum())
    assert 0.85 < square / stated < 1.2


def test_chance_has_no_score():
    scores = [most_likely(*made(40, 0, 0.0, seed)[:2])[0] for seed in range(60)]
    assert max(scores) < 2.5
    assert np.median(scores) < 0.5


def test_effects_that_no_reading_determines_stay_unknown():
    score, mean, covariance = most_likely(np.zeros((2, 3)), np.zeros((2, 3, 3)))
    assert score < 1e-6
    assert not mean.any()
    assert np.isfinite(covariance).all()


def test_no_effect_follows_where_information_is_rounding():
    """The slope along what no reading tells is rounding, too."""
    _, alone, _ = most_likely(np.array([[3e3]]), np.array([[[1e4]]]))
    slope, information = np.array([[3e3, 30.0]]), np.diag([1e4, 1e-7])[None]
    _, mean, _ = most_likely(slope, information)
    np.testing.assert_allclose(mean[0], [alone[0, 0], 0.0], rtol=1e-9)


def test_held_effects_count_with_their_squares():
    moved = np.array([[3e-5, 0.0], [1e-5, -2e-5]])
    held = SmallEffects(5.0, moved, np.stack([np.eye(2) * 1e-10] * 2)).held()
    assert held.score == 5.0
    assert not held.displacements.any()
    expected = 1e-10 * np.array([[[10, 0], [0, 1]], [[2, -2], [-2, 5]]])
    np.testing.assert_allclose(held.covariances, expected, atol=1e-18)
