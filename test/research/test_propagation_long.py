"""The compiled propagation stays equal to the textbook's over ten minutes."""

from support.reference_filter import difference_to_reference


def test_ten_minutes_equal_the_reference() -> None:
    """State and covariance to 1e-9 of their size after 60 000 steps of the compiled kernel."""
    assert difference_to_reference(100.0, 600.0) < 1e-9
