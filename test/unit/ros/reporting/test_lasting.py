"""Conditions that last are logged, and summed up at the end."""

from hybrid_ins.ros.reporting.lasting import LastingConditions


def test_what_lasts_is_logged_and_summed_up() -> None:
    log: list[str] = []
    lasting = LastingConditions(lambda level, text: log.append(f"{level}: {text}"))
    for second in range(61):
        lasting.note({"the IMU disagrees": "the IMU disagrees: check it"} if second >= 13 else {})

    assert log == ["warn: the IMU disagrees: check it (for 10 s so far)"]
    assert lasting.summary() == "the IMU disagrees for 48 of 61 s"


def test_what_passes_is_not_mentioned() -> None:
    log: list[str] = []
    lasting = LastingConditions(lambda level, text: log.append(text))
    for second in range(600):
        lasting.note({"the IMU disagrees": "text"} if second < 9 else {})

    assert not log and lasting.summary() == ""
