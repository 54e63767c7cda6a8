"""How an evaluation goes on after a stop."""

import os
import time
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


def _load(folder):
    """What processes measure: each loads it once."""
    (folder / f"process {os.getpid()}").touch()
    return folder


def _measure(folder, name):
    (folder / name).touch()
    if name == "bad":
        raise ValueError("a bad part")
    if name == "last":
        time.sleep(0.5)  # while the error is told
    return {"name": name}


def test_processes_share_the_parts_and_an_error_ends_all(tmp_path):
    def measured(names, jobs):
        parts = [Part(_measure, (name,)) for name in names]
        kept = Kept(tmp_path / "measured.json", 1)
        return measure_all(parts, None, partial(_load, tmp_path), kept, jobs, lambda done: None)

    found = measured("abc", 2)
    assert [each["name"] for each in found.values()] == ["a", "b", "c"]
    assert 1 <= len(list(tmp_path.glob("process*"))) <= 2
    never = [f"{i}" for i in range(20)]
    with pytest.raises(ValueError, match="a bad part"):
        measured(["a", "bad", "last", "last", *never], 2)
    assert not (tmp_path / never[-1]).exists()
    assert len(measured("abc", 1)) == 3  # which were kept
