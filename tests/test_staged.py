"""Time-window circularity of the staged formula, the closed form of other tests: published figures, its integral."""

from __future__ import annotations

import numpy as np
import pytest
from batch_circularity import staged_circularity, time_window_circularity


@pytest.mark.parametrize(
    ("masses", "success", "published"),
    [((5, 2), 0, -7.197), ((5, 2), 100, -4.88), ((1, 1), 100, -2.134), ((2, 2), 0, -6.30), ((2, 2), 100, -4.27)],
)
def test_time_window_circularity_of_ciro(masses: tuple[float, ...], success: float, published: float) -> None:
    """The published figures, with a sorting time of a day, to the digits that are known."""
    found = time_window_circularity(
        masses, (0.1, 0.95), success=success, use=2_592_000, sorting_time=86_400, truck=3_600, incineration=86_400
    )
    digits = len(str(published).split(".")[1])
    assert round(found, digits) == published


def test_time_window_is_twice_the_mean_of_the_stages() -> None:
    """Integrating λ(t) of a batch over the window gives the same, whatever the times."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        use, sorting, incineration = rng.uniform(1.0, 9.0, 3)
        truck, success = rng.uniform(0.0, use), rng.uniform(0.0, 100.0)
        trucked, used = use + sorting + truck, use + sorting + use
        edges = np.array([0.0, trucked, used, used + incineration])
        at = (edges[1:] + edges[:-1]) / 2  # one point within each stage
        mean = np.dot(
            staged_circularity(at, mass=7.0, success=success, departure=0.0, truck_arrival=trucked, use_end=used),
            np.diff(edges),
        )
        times = {"use": use, "sorting_time": sorting, "truck": truck, "incineration": incineration}
        expected = 2.0 * 0.3 * mean / edges[-1]
        assert time_window_circularity([7.0], [0.3], success=success, **times) == pytest.approx(expected, rel=1e-12)
