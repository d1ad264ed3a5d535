import pytest

from mujoban_core.text import readable


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"), (0.97656, "0.977"), (-12.345, "-12.3"), (999.4, "999"), (999.7, "1,000"), (1120.4, "1,120"),
        (1234567.0, "1,234,567"), (3e-5, "3.0e-05"), (float("nan"), "nan"),
    ],
)  # fmt: skip
def test_numbers_keep_the_digits_that_count_and_are_written_out(value, text):
    assert readable(value) == text
