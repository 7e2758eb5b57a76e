from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tesnet.geometry import CameraIntrinsics

CAMERA = CameraIntrinsics(8, 6, 10.0, 12.0, 3.5, 2.5)


def test_back_projected_points_project_to_their_pixels() -> None:
    depth = np.random.default_rng(0).uniform(0.3, 2, (6, 8))
    points = CAMERA.back_project(depth)
    assert points.shape == (48, 3)
    u = points[:, 0] / points[:, 2] * CAMERA.fx + CAMERA.cx
    v = points[:, 1] / points[:, 2] * CAMERA.fy + CAMERA.cy
    rows, columns = np.divmod(np.arange(48), 8)
    np.testing.assert_allclose(u, columns, atol=1e-12)
    np.testing.assert_allclose(v, rows, atol=1e-12)
    np.testing.assert_allclose(points[:, 2], depth.ravel())


def test_pixels_without_depth_give_no_point() -> None:
    depth = np.ones((6, 8))
    depth[0, :5] = [0, -1, np.nan, np.inf, -np.inf]
    points = CAMERA.back_project(depth)
    assert len(points) == 48 - 5
    assert np.isfinite(points).all()
    assert len(CAMERA.back_project(np.zeros((6, 8)))) == 0


def test_an_image_of_another_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"\(8, 6\).*\(6, 8\)"):
        CAMERA.back_project(np.ones((8, 6)))


@pytest.mark.parametrize("field", ["width", "height", "fx", "fy"])
@pytest.mark.parametrize("value", [0, -1, float("nan")])
def test_a_camera_needs_positive_sizes(field: str, value: float) -> None:
    good: dict[str, Any] = {"width": 8, "height": 6, "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0}
    with pytest.raises(ValueError, match=f"{field} is"):
        CameraIntrinsics(**{**good, field: value})
