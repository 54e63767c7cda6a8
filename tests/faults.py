"""The report that the long tests of faults leave: runs/faults/report.json."""

import json
from pathlib import Path

REPORT = Path(__file__).parents[1] / "runs" / "faults" / "report.json"


def recorded(part: str) -> dict:
    """The figures of a part so far."""
    return json.loads(REPORT.read_text()).get(part, {}) if REPORT.is_file() else {}


def record(part: str, **figures) -> None:
    """Puts figures under the name of a part, beside what is there."""
    REPORT.parent.mkdir(parents=True, exist_ok=True)
    report = json.loads(REPORT.read_text()) if REPORT.is_file() else {}
    report[part] = report.get(part, {}) | figures
    REPORT.write_text(json.dumps(report, indent=1) + "\n")
