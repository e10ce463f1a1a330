"""The analyzers for diagnostic_aggregator find the node's statuses."""

import yaml
from support.drive import Drive
from support.paths import ROOT


def test_analyzers_find_every_status() -> None:
    file = ROOT / "config" / "diagnostics" / "analyzers.yaml"
    (section,) = yaml.safe_load(file.read_text(encoding="utf-8")).values()
    group = section["ros__parameters"]["analyzers"]["navigation"]
    (analyzer,) = group["analyzers"].values()

    statuses = Drive().estimator.status.diagnostics(1)

    assert len(statuses) >= 4
    for status in statuses:
        assert any(status.name.startswith(start) for start in analyzer["startswith"])
