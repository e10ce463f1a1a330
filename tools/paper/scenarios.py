"""The methods and the scenarios of the paper's evaluation."""

from __future__ import annotations

from dataclasses import replace

from hybrid_ins.simulation.motions import car_drive
from hybrid_ins.simulation.sensors import ImuErrors, Tone
from tools.paper.montecarlo import CONSTANTS, Method
from tools.paper.runs import Scenario

ORACLE = Method("oracle", "oracle")
OURS = Method("ours", "learned")
PAPER = Method("paper's network", "learned", model="paper")
AQ = tuple(Method(f"AQ{k}", "innovation", window=xi) for k, xi in ((1, 1), (2, 3), (3, 5)))
METHODS = (
    ORACLE,
    OURS,
    replace(OURS, name="ours × innovation scale", kind="scaled"),
    Method("spectral", "learned", model="spectral"),
    PAPER,
    *AQ,
    *CONSTANTS,
)
AS_PRINTED = (
    replace(CONSTANTS[2], name="CQ3 as printed", as_printed=True),
    *(replace(m, name=f"{m.name} literal", kind="literal") for m in AQ),
)
PACES = (
    *(
        replace(OURS, name=f"every {period:g} s", refresh=period)
        for period in (0.05, 0.2, 0.5, 1.0, 2.0)
    ),
    replace(OURS, name="every 0.2 s, half of the last kept", smoothing=0.5),
    replace(OURS, name="every 0.05 s, 0.8 of the last kept", refresh=0.05, smoothing=0.8),
)
ROUGH = (5.0, 20.0)
OUTAGES = ((25.0, 10.0), (50.0, 20.0), (85.0, 30.0))
VIBRATION = ImuErrors(tones=(Tone(48.0, 2.0, 0.2), Tone(96.0, 1.0, 0.1), Tone(143.0, 1.0, 0.1)))
PAPER_RANGE = ImuErrors(accelerometer_std=0.001**0.5, gyroscope_std=0.001**0.5)
TABLE_ONE = Scenario("Table I, constant noise, 1000 Hz", rate=1000.0, duration=60.0)
SWITCHING = tuple(
    Scenario(f"switching noise, {rate:g} Hz", rate=rate, rough=ROUGH)
    for rate in (100.0, 200.0, 1000.0)
)
SWITCHING_OUTAGES = tuple(replace(s, name=f"{s.name}, outages", outages=OUTAGES) for s in SWITCHING)
SCENARIOS = (
    TABLE_ONE,
    replace(TABLE_ONE, name=f"{TABLE_ONE.name}, outage of 20 s", outages=((35.0, 20.0),)),
    *SWITCHING,
    *SWITCHING_OUTAGES,
    Scenario("vibration, 200 Hz", errors=VIBRATION),
    Scenario("q between 0.001 and 0.025, 100 Hz", rate=100.0, errors=PAPER_RANGE, rough=(5.0, 5.0)),
)
ASIDE = Scenario(
    "kept aside: a car, 400 Hz, vibration, factors of 2 to 30",
    motion=car_drive,
    rate=400.0,
    rough=(2.0, 30.0),
    dwell=(2.0, 20.0),
    outages=((60.0, 15.0),),
    errors=ImuErrors(0.03, 0.001, tones=(Tone(31.0, 0.6, 0.02), Tone(117.0, 1.5, 0.05))),
)
WITH_PRINTED = (TABLE_ONE, SWITCHING[1], SWITCHING_OUTAGES[1])
