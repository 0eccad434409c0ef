import numpy as np

from lvba.kernels import light_ratios
from lvba.visual import radiometry, response
from lvba.visual.ratios import Ratios
from lvba.visual.vignetting import PairPlaces


def test_the_kernel_is_as_its_twin_in_numpy():
    rng = np.random.default_rng(3)
    count = 4000
    # some beyond the corner, where light falls off no more
    places = PairPlaces(rng.uniform(-1.2, 1.2, (count, 2)), rng.uniform(-1.2, 1.2, (count, 2)))
    ratios = Ratios(
        first=np.zeros(count, np.int32),
        second=np.ones(count, np.int32),
        value=rng.normal(0, 0.4, count),
        sigma=np.full(count, 0.01),
        block=np.zeros(count, np.int64),
        stretch=np.zeros(count, np.int64),
        level=np.log(rng.uniform(8, 254, count)),
        patch=np.arange(count),
        places=places,
        nearer=rng.normal(0, 0.3, count),
    )
    # slopes that no camera has are among them
    numbers = np.concatenate([[-0.2, 0.1, -0.05, 0.01, -0.02], [0.03], rng.normal(0, 0.6, response.SLOPES)])
    present, sign, common = (
        radiometry.of_numbers(numbers),
        rng.choice([-1.0, 1.0], count),
        rng.normal(0, 0.5, count),
    )

    by_numbers, values, rest = light_ratios.linearize(
        ratios.arrays(sign), common, present.numbers, response.KNOTS, response.STEEPEST
    )

    table = sign[:, None] * ratios.by_numbers(present, ratios.of_views(present) + sign * common)
    fallen = sign * (ratios.value - places.log_ratio(present.vignetting))
    expected = fallen + table[:, radiometry.FALLOFF] @ present.vignetting.numbers
    np.testing.assert_allclose(by_numbers, table, atol=1e-12)
    np.testing.assert_allclose(values, expected, atol=1e-12)
    np.testing.assert_allclose(rest, expected - table @ present.numbers, atol=1e-12)
