"""Classifier: arithmetic of the network, calibration, identity, files."""

import io
import zipfile

import numpy as np
import pytest

from sonarpost.detection.chips import COARSE_PLANES, COARSE_SHAPE, FINE_PLANES, FINE_SHAPE, GEOMETRY_VALUES, ChipBatch
from sonarpost.detection.classifier import (
    COARSE_CHANNELS,
    FINE_CHANNELS,
    Classifier,
    default_classifier,
    load_classifier,
    load_classifier_once,
    weight_shapes,
)
from sonarpost.detection.detector import classifier_of
from sonarpost.detection.settings import DetectorSettings
from sonarpost.errors import ConfigError


def random_chips(count, seed=0):
    rng = np.random.default_rng(seed)
    return ChipBatch(
        rng.standard_normal((count, *FINE_SHAPE, FINE_PLANES)).astype(np.float32),
        rng.standard_normal((count, *COARSE_SHAPE, COARSE_PLANES)).astype(np.float32),
        rng.random((count, GEOMETRY_VALUES)).astype(np.float32),
    )


def random_weights(seed=0):
    rng = np.random.default_rng(seed)
    weights = {name: (rng.standard_normal(shape) * 0.1).astype(np.float32) for name, shape in weight_shapes().items()}
    return {**weights, "calibration": np.array([1, 0, 0, 0], np.float32)}


def slow_convolution(planes, kernel, bias):
    rows, columns, _ = planes.shape
    padded = np.pad(planes.astype(np.float64), ((1, 1), (1, 1), (0, 0)))
    out = np.zeros((rows, columns, kernel.shape[-1]))
    for r in range(rows):
        for c in range(columns):
            out[r, c] = np.einsum("ijk,ijkl->l", padded[r : r + 3, c : c + 3], kernel.astype(np.float64)) + bias
    return np.maximum(out, 0)


def slow_pool(planes):
    rows, columns = planes.shape[0] // 2, planes.shape[1] // 2
    return planes[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, -1).max(axis=(1, 3))


def slow_network(weights, fine, coarse, geometry):
    for n in range(len(FINE_CHANNELS)):
        fine = slow_convolution(fine, weights[f"fine{n}"], weights[f"fine{n}_bias"])
        fine = slow_pool(fine) if n < len(FINE_CHANNELS) - 1 else fine
    for n in range(len(COARSE_CHANNELS)):
        coarse = slow_pool(slow_convolution(coarse, weights[f"coarse{n}"], weights[f"coarse{n}_bias"]))
    inputs = np.concatenate([fine.ravel(), coarse.ravel(), geometry])
    hidden = np.maximum(inputs @ weights["hidden"].astype(np.float64) + weights["hidden_bias"], 0)
    return hidden @ weights["output"].astype(np.float64) + weights["output_bias"]


def test_network_equals_its_definition():
    weights, chips = random_weights(), random_chips(1)
    one = slow_network(weights, chips.fine[0], chips.coarse[0], chips.geometry[0])
    other = slow_network(weights, chips.fine[0, ::-1], chips.coarse[0, ::-1], chips.geometry[0])
    np.testing.assert_allclose(Classifier(weights).outputs(chips)[0], (one + other) / 2, rtol=1e-3, atol=1e-4)


def test_result_depends_neither_on_the_batch_nor_on_the_direction_of_travel():
    classifier, chips = default_classifier(), random_chips(50)
    together = classifier.probabilities(chips)
    assert together.shape == (50, 3)
    np.testing.assert_allclose(together.sum(axis=1), 1.0, atol=1e-5)
    alone = classifier.probabilities(chips.selected(np.array([49])))
    np.testing.assert_allclose(alone[0], together[49], atol=1e-5)
    np.testing.assert_allclose(classifier.probabilities(chips.mirrored()), together, atol=1e-5)
    assert classifier.probabilities(chips.selected(np.arange(0))).shape == (0, 3)


def test_calibration_changes_probabilities_by_slope_and_offset():
    outputs = np.array([[0.0, 1.0, 2.0]], dtype=np.float32)
    calibration = np.array([2.0, 0.0, 0.0, -4.0], np.float32)
    classifier = Classifier({**random_weights(), "calibration": calibration})
    odds = np.exp([0.0, 2.0, 0.0])
    np.testing.assert_allclose(classifier.calibrated(outputs)[0], odds / odds.sum(), rtol=1e-5)


def test_file_has_the_same_identity_after_writing_again(tmp_path):
    path = tmp_path / "weights.npz"
    np.savez_compressed(path, **default_classifier().weights)
    identity = default_classifier().identity
    assert load_classifier(path).identity == load_classifier(path, identity).identity == identity
    assert Classifier(random_weights(1)).identity != Classifier(random_weights(2)).identity
    settings = DetectorSettings(classifier=str(path), classifier_identity=identity)
    assert classifier_of(settings).identity == identity
    assert classifier_of(DetectorSettings()) is default_classifier()
    with pytest.raises(ConfigError, match=r"weights.npz: identity: got .[0-9a-f]{16}., expected 0{16}"):
        load_classifier_once(path, "0" * 16)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hidden": None}, "arrays: got"),
        ({"extra": np.zeros(1, np.float32)}, "arrays: got"),
        ({"output_bias": np.zeros(4, np.float32)}, "output_bias: got shape"),
        ({"output_bias": np.zeros(3)}, "output_bias: got float64"),
        ({"output_bias": np.full(3, np.nan, np.float32)}, "output_bias: got a value"),
        ({"output_bias": np.full(3, 1e6, np.float32)}, "output_bias: got a value"),
        ({"output_bias": np.array([None, 1, 2], dtype=object)}, "Object arrays cannot be loaded"),
    ],
)
def test_error_names_the_invalid_array(tmp_path, changes, message):
    path = tmp_path / "weights.npz"
    weights = {**random_weights(), **changes}
    np.savez(path, **{name: value for name, value in weights.items() if value is not None})
    with pytest.raises(ConfigError, match=message):
        load_classifier(path)


def test_file_that_is_no_archive_or_unpacks_to_a_large_size_is_refused(tmp_path):
    path = tmp_path / "weights.npz"
    with pytest.raises(ConfigError, match="a readable file"):
        load_classifier(path)
    for content in (b"", b"PK\x03\x04", b"not an archive", b"\x93NUMPY\x01\x00"):
        path.write_bytes(content)
        with pytest.raises(ConfigError, match="weights"):
            load_classifier(path)
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(1 << 23, np.float32))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("hidden.npy", buffer.getvalue())
    with pytest.raises(ConfigError, match="bytes unpacked"):
        load_classifier(path)
