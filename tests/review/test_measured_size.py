"""Size of an object from the measurements of operators."""

from sonarpost.review.measurement import MeasuredSize, measured_size


def body(kind, value_m, **fields):
    return {
        "id": 1,
        "kind": kind,
        "value_m": value_m,
        "sigma_m": 0.1,
        "height_m": None,
        "height_sigma_m": None,
        **fields,
    }


def test_latest_measurement_of_each_quantity_counts():
    found = measured_size([body("length", 2.0), body("width", 0.5), body("length", 1.9)])
    assert (found.length_m, found.length_sigma_m, found.width_m, found.shadow_m) == (1.9, 0.1, 0.5, None)
    assert found.text == "L 1.90 ± 0.10 m, W 0.50 ± 0.10 m"


def test_withdrawn_measurement_does_not_count():
    assert measured_size([body("length", 2.0), body("length", 9.0, withdrawn_utc_s=1.0)]).length_m == 2.0
    assert measured_size([body("length", 9.0, withdrawn_utc_s=1.0)]) == MeasuredSize()


def test_height_is_that_of_the_latest_shadow():
    first = body("shadow", 3.0, height_m=0.6, height_sigma_m=0.05)
    assert measured_size([first]).text == "shadow 3.00 ± 0.10 m, H 0.60 ± 0.05 m"
    # The second shadow has no height: the altitude of the vehicle was unknown.
    assert measured_size([first, body("shadow", 4.0)]).height_m is None
