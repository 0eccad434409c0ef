"""PSNR and SSIM against scikit-image."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from lvba.products import metrics


def pair(seed, noise, hole):
    rng = np.random.default_rng(seed)
    smooth = np.kron(rng.uniform(20, 230, (8, 10, 3)), np.ones((8, 8, 1)))
    raw = np.clip(smooth + rng.normal(0, 10, smooth.shape), 0, 255).astype(np.uint8)
    color = np.clip(raw + rng.normal(0, noise, raw.shape), 0, 255).astype(np.float32)
    covered = rng.random(raw.shape[:2]) >= hole
    color[~covered] = 0
    return raw, color, covered


@pytest.mark.parametrize(("noise", "hole"), [(0.5, 0), (20, 0), (5, 0.2), (60, 0.8)])
def test_whole_images_score_as_in_scikit_image(noise, hole):
    raw, color, covered = pair(1, noise, hole)
    everywhere = np.ones_like(covered)
    found = metrics.compare(metrics.prepare(raw), color, metrics.regions(covered, everywhere))
    luma = [image.astype(float) @ [0.299, 0.587, 0.114] for image in (raw, color)]
    expected = structural_similarity(
        *luma, data_range=255, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert found.ssim_whole[1] == pytest.approx(expected, abs=1e-6)
    expected = peak_signal_noise_ratio(raw.astype(float), color.astype(float), data_range=255)
    assert found.psnr[1] == pytest.approx(expected, abs=1e-4)


def test_holes_do_not_change_the_score_of_a_perfect_rendering():
    raw, _, covered = pair(2, 0, 0.5)
    color = np.where(covered[..., None], raw, 0).astype(np.float32)
    found = metrics.compare(metrics.prepare(raw), color, metrics.regions(covered))
    assert found.ssim_alone[0] == pytest.approx(1, abs=1e-5)
    assert found.ssim_whole[0] < 0.7
    assert found.psnr[0] == metrics.PSNR_MAX_DB


def test_covered_pixels_alone_match_explicit_weighted_windows():
    raw, color, covered = pair(3, 15, 0.4)
    prepared = metrics.prepare(raw)
    x, y = (image.astype(float) @ [0.299, 0.587, 0.114] for image in (raw, color))
    tap = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(tap, tap)
    for row, column in ((5, 5), (10, 10), (30, 41), (50, 70), (58, 74)):
        near = (slice(row - 5, row + 6), slice(column - 5, column + 6))
        weight = window * covered[near]
        weight /= weight.sum()
        mx, my = (weight * x[near]).sum(), (weight * y[near]).sum()
        vx, vy = (weight * (x[near] - mx) ** 2).sum(), (weight * (y[near] - my) ** 2).sum()
        cov = (weight * (x[near] - mx) * (y[near] - my)).sum()
        c1, c2 = 2.55**2, 7.65**2
        expected = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
        here = np.zeros_like(covered)
        here[row, column] = True
        alone = metrics.compare(prepared, color, metrics.regions(covered, here)).ssim_alone[1]
        assert alone == pytest.approx(expected, abs=1e-4)


def test_every_region_is_summed_by_itself():
    raw, color, covered = pair(5, 10, 0.3)
    column, row = np.arange(80) + 0 * covered, np.arange(64)[:, None] + 0 * covered
    masks = covered, column < 40, row < 30, column + row < 50
    found = metrics.compare(metrics.prepare(raw), color, metrics.regions(*masks))
    error = ((color - raw) ** 2).mean(2)
    for psnr, mask in zip(found.psnr, masks, strict=True):
        assert psnr == pytest.approx(10 * np.log10(255**2 / error[mask].mean()), abs=1e-4)


def test_nothing_covered_gives_nan():
    raw, color, covered = pair(4, 1, 1.1)
    assert not covered.any()
    found = metrics.compare(metrics.prepare(raw), color, metrics.regions(covered))
    assert np.isnan(found.psnr[0])
    assert np.isnan(found.ssim_alone[0])


def test_an_image_smaller_than_a_window_has_no_ssim():
    raw, color, covered = (part[:9, :30] for part in pair(6, 5, 0))
    found = metrics.compare(metrics.prepare(raw), color, metrics.regions(covered))
    assert np.isnan(found.ssim_whole[0])
    assert np.isfinite(found.psnr[0])
