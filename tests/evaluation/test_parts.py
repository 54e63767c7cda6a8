"""How an evaluation goes on after a stop."""

from functools import partial

import pytest

from clothjax.evaluation.parts import Kept, Part, measure_all


def test_an_evaluation_that_was_stopped_goes_on_where_it_was(tmp_path):
    stops, asked, told = ["c"], [], []
    path = tmp_path / "measured.json"

    def measure(measured, name, *about):
        assert measured == "all" and about == ("thin",)
        asked.append(name)
        if name in stops:
            raise KeyboardInterrupt
        return {"psi": {"gap": 0.1 * ord(name), "finite": True}}

    parts = [Part(measure, (name, "thin")) for name in "abcd"]

    def evaluate(of):
        asked.clear()
        told.clear()
        return measure_all(parts, "all", None, Kept(path, of), 1, told.append)

    with pytest.raises(KeyboardInterrupt):
        evaluate(7)
    stops.clear()
    found = evaluate(7)
    assert asked == ["c", "d"] and told == [3, 4] and list(found) == parts
    assert evaluate(7) == found and not asked
    path.unlink()
    assert evaluate(7) == found and asked == ["a", "b", "c", "d"]

    path.unlink()
    stops.append("c")
    with pytest.raises(KeyboardInterrupt):
        evaluate(7)
    stops.clear()
    assert evaluate(8) == found and asked == ["a", "b", "c", "d"]  # another model
    for damaged in ('{"of": 8}', '{"of": 8, "parts": 3}', "{"):
        path.write_text(damaged)
        with pytest.raises(ValueError, match=r"measured\.json: not what an evaluation leaves .*; remove it"):
            evaluate(8)


def _load(path):
    """What processes measure: how often it was loaded is in a file."""
    with path.open("a") as file:
        file.write("x")
    return path


def _measure(path, name):
    if name == "bad":
        raise ValueError("a bad part")
    return {"loaded": len(path.read_text()), "name": name}


def test_processes_share_the_parts_and_an_error_ends_all(tmp_path):
    kept, loads = Kept(tmp_path / "measured.json", 1), tmp_path / "loads"
    parts = [Part(_measure, (name,)) for name in ("a", "b", "c")]
    found = measure_all(parts, None, partial(_load, loads), kept, 2, lambda done: None)
    assert [found[part]["name"] for part in parts] == ["a", "b", "c"]
    assert len(loads.read_text()) <= 2  # once a process
    with pytest.raises(ValueError, match="a bad part"):
        measure_all([*parts, Part(_measure, ("bad",))], None, partial(_load, loads), kept, 2, lambda done: None)
    assert set(kept.read()) == {part.name for part in parts}
