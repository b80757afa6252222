"""Share of the time in which a vehicle transmits, with feedback from the vessel."""

from research.utilisation import UtilisationSpec, measure_utilisation


def test_vehicle_at_rate_5_transmits_most_of_the_time_and_receives_feedback() -> None:
    result = measure_utilisation(UtilisationSpec(rate=5, seconds=1200.0))
    assert result.busy >= 0.95
    assert result.frames_full > 0.99
    assert result.feedback_received >= 6
    assert result.feedback_received >= 0.8 * result.feedback_sent


def test_time_without_receive_windows_and_with_a_slow_serial_line() -> None:
    result = measure_utilisation(UtilisationSpec(rate=1, rx_window_s=0.0, frame_loss=0.0, seconds=300.0))
    assert result.busy > 0.995
    assert result.feedback_received == 0
    slow = measure_utilisation(UtilisationSpec(rate=5, serial_baud=19_200.0, rx_window_s=0.0, seconds=120.0))
    fast = measure_utilisation(UtilisationSpec(rate=5, serial_baud=115_200.0, rx_window_s=0.0, seconds=120.0))
    assert 0.5 < slow.busy < 0.7
    assert 0.85 < fast.busy < 0.95
