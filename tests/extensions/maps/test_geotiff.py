"""GeoTIFF: cloud-optimised layout, overviews, sizes; UTM zones."""

import numpy as np
import pytest
import tifffile
from builders import gdal

from sonarpost.extensions.maps import geotiff
from sonarpost.extensions.maps.geotiff import GeoTransform, write_image
from sonarpost.extensions.maps.track import utm_epsg
from sonarpost.sonar.geometry import Position

LAYOUTS = pytest.mark.parametrize(
    ("size_px", "is_big"), [((1, 1), False), ((512, 512), True), ((513, 5), False), ((1100, 1030), True)]
)


def written(folder, monkeypatch, size_px, is_big):
    """Write an image of noise; return its file and its pixels."""
    if is_big:
        monkeypatch.setattr(geotiff, "_CLASSIC_BYTES", 0)
    image = np.random.default_rng(0).integers(0, 256, size_px, dtype=np.uint8)
    write_image(folder / "m.tif", image, GeoTransform(32619, (5e5, 5.3e6), (0.5, 0.0), (0.0, -0.5)))
    return folder / "m.tif", image


@LAYOUTS
def test_images_of_any_size_are_kept(tmp_path, monkeypatch, size_px, is_big):
    path, image = written(tmp_path, monkeypatch, size_px, is_big)
    np.testing.assert_array_equal(tifffile.imread(path), image)
    with tifffile.TiffFile(path) as file:
        assert file.is_bigtiff is is_big


@gdal.needs_bindings
@LAYOUTS
def test_gdal_accepts_the_layout_as_cloud_optimised(tmp_path, monkeypatch, size_px, is_big):
    assert gdal.cloud_optimised_problems(written(tmp_path, monkeypatch, size_px, is_big)[0]) == "([], [])"


def test_overviews_are_means_of_pixels_with_data(tmp_path):
    image = np.zeros((600, 600), np.uint8)
    image[:2, :4] = [[100, 0, 10, 20], [50, 0, 30, 41]]
    write_image(tmp_path / "m.tif", image, GeoTransform(32619, (5e5, 5.3e6), (1.0, 0.0), (0.0, -1.0)))
    with tifffile.TiffFile(tmp_path / "m.tif") as file:
        assert [page.shape for page in file.pages] == [(600, 600), (300, 300)]
        reduced = file.pages[1].asarray()
    assert reduced[0, :3].tolist() == [75, 25, 0]


def test_utm_zone():
    zones = {(48.4, -68.8): 32619, (-33.0, 151.0): 32756, (0.0, 180.0): 32660, (5, -180): 32601}
    assert {place: utm_epsg(Position(*place)) for place in zones} == zones
