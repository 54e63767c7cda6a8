"""Two reports of the benchmark side by side: the times that changed by more than noise.

The noise is that of medians. Times measured once, such as a compilation or a rollout of Phi, may differ by more.
"""

import math

from experiments.benchmark import pareto

TIMES = {"us", "ms", "seconds"}


def compare(new: dict, old: dict) -> dict:
    """Return ratios of times, new over old, by place in the report, and those beyond the noise of both."""
    result = {"other_machine": [key for key in new["machine"] if new["machine"][key] != old["machine"].get(key)]}
    for part in (key for key in new if key in old and key != "machine"):
        here, there = times(new[part]), times(old[part])
        ratios = {name: here[name] / there[name] for name in here if there.get(name, 0.0) > 0.0 and here[name] > 0.0}
        noise = (new[part].get("noise") or 1.0) * (old[part].get("noise") or 1.0)
        result[part] = {
            "ratios": ratios,
            "noise": noise,
            "beyond_noise": [name for name, ratio in ratios.items() if abs(math.log(ratio)) > math.log(noise)],
        }
        if part == "pareto":
            result[part]["rank_tau"] = pareto.rank_tau(new[part]["points"], old[part]["points"])
    return result


def times(part, place: str = "", timed: bool = False) -> dict[str, float]:
    """Return the times of a report by their place in it: entries with a unit of time in their name or their table's."""
    if isinstance(part, dict):
        leaves = {}
        for key, value in part.items():
            below = f"{place}/{key}" if place else key
            of_time = bool(TIMES & set(key.split("_"))) and not key.endswith("_ratio")
            leaves |= times(value, below, timed or of_time)
        return leaves
    if isinstance(part, list):
        leaves = {}
        for row in part:
            if isinstance(row, dict) and "name" in row:
                name = " ".join(str(row[key]) for key in ("garment", "run", "name") if row.get(key))
                leaves |= times(row, f"{place}/{name}", timed)
        return leaves
    number = isinstance(part, int | float) and not isinstance(part, bool)
    return {place: float(part)} if timed and number else {}


def lines(compared: dict) -> list[str]:
    """Return the comparison as readable lines."""
    said = []
    if compared["other_machine"]:
        said.append(f"not the same machine as then: {', '.join(compared['other_machine'])} differ")
    for part, result in compared.items():
        if part == "other_machine":
            continue
        beyond = {name: result["ratios"][name] for name in result["beyond_noise"]}
        said.append(
            f"{part}: {len(result['ratios'])} times compared, {len(beyond)} differ by more than noise "
            f"({result['noise']:.2f} x)"
        )
        said += [
            f"  {'SLOWER' if ratio > 1 else 'faster'} {ratio:.2f} x  {name}"
            for name, ratio in sorted(beyond.items(), key=lambda item: -item[1])
        ]
        if "rank_tau" in result:
            said.append("  order of the points, Kendall's tau: " + str(result["rank_tau"]))
    return said
