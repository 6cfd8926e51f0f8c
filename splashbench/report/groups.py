"""Results that may be compared: one machine, one protocol, and scenes that told the same; and in each the methods.

Figures of two groups never share a chart or a mean: they would compare machines, protocols or hints, not methods.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

from splashbench.errors import one_line
from splashbench.report.results import ResultFile
from splashbench.score.result import Result

#: The control that shows a scene without liquid.
NOTHING = "nothing"
_MAX_TOLD = 300
# Different sets of scenes whose intersections `comparable` tries; the work grows with their square.
_MAX_SETS = 40


@dataclass
class Entry:
    """A method with its settings within a group. label: names it there. results: in the order of scene and seed."""

    label: str
    results: list[Result] = field(default_factory=list)

    @property
    def first(self) -> Result:
        """Any of the results: what names a method is the same in all."""
        return self.results[0]

    @property
    def scenes(self) -> set[str]:
        """Digests of the scenes it ran on, whatever came out."""
        return {result.digests.scene for result in self.results}


@dataclass
class Group:
    """What was measured on one machine by one protocol with scenes that told the same; told: None where not noted.

    backgrounds: results of the control `nothing` on the group's scenes, by its protocol; those of other machines where
    it was not run on this one, since what it shows hardly depends on the machine, and it needs no GPU.
    """

    machine: str
    protocol: str
    told: tuple[str, ...] | None
    entries: list[Entry] = field(default_factory=list)
    controls: list[Entry] = field(default_factory=list)
    backgrounds: list[Result] = field(default_factory=list)

    @property
    def scenes(self) -> dict[str, str]:
        """Digest to name of every scene, in the order of names; those of one name are told apart by their digests."""
        found = {r.digests.scene: r.scene for entry in [*self.entries, *self.controls] for r in entry.results}
        count = Counter(found.values())
        shown = {d: name if count[name] == 1 else f"{name} {d[:8]}" for d, name in found.items()}
        return dict(sorted(shown.items(), key=lambda item: item[1]))

    @cached_property
    def longest_fit_seconds(self) -> float:
        """The longest fit of its entries, 0 where none was timed. Ask only once all entries are in."""
        return max((r.value("fit_seconds") or 0.0 for entry in self.entries for r in entry.results), default=0.0)

    @property
    def told_text(self) -> str:
        """What the scenes told, in words."""
        return told_text(self.told)


def told_text(told: tuple[str, ...] | None) -> str:
    """`Result.told` in words."""
    if told is None:
        return "not noted"
    return one_line(", ".join(told))[:_MAX_TOLD] or "nothing"


def groups(sources: Sequence[ResultFile]) -> list[Group]:
    """All results, by group and entry, in one order. Nothing is left out: failed runs stand with the others."""
    by_key: dict[tuple[str, str, str], list[Result]] = defaultdict(list)
    backgrounds: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for source in sources:
        result = source.result
        by_key[result.hardware_label, result.protocol_label, told_text(result.told)].append(result)
        if result.method == NOTHING and result.control and result.status == "ok":
            backgrounds[result.digests.scene, result.protocol_label].append(result)
    return [_group(results, backgrounds) for _, results in sorted(by_key.items())]


def _group(results: list[Result], backgrounds: Mapping[tuple[str, str], list[Result]]) -> Group:
    group = Group(results[0].hardware_label, results[0].protocol_label, results[0].told)
    for scene in sorted({result.digests.scene for result in results}):
        found = backgrounds.get((scene, group.protocol), [])
        own = [result for result in found if result.hardware_label == group.machine]
        group.backgrounds += own or found
    names = labels(results)
    entries: dict[tuple[str, str, str], Entry] = {}
    for result in sorted(results, key=lambda r: (r.scene, r.digests.scene, r.seed, r.digests.submission)):
        key = entry_key(result)
        entries.setdefault(key, Entry(names[key])).results.append(result)
    for entry in sorted(entries.values(), key=lambda entry: entry.label):
        (group.controls if entry.first.control else group.entries).append(entry)
    return group


def entry_key(result: Result) -> tuple[str, str, str]:
    """Method, preset and settings: runs that differ in any are never averaged."""
    return (result.method, result.preset, result.settings_digest)


def labels(results: Iterable[Result]) -> dict[tuple[str, str, str], str]:
    """Method, with the preset where it has several, and the settings' digest where a preset has several."""
    keys = {entry_key(result) for result in results}
    presets = Counter(method for method, _ in {key[:2] for key in keys})
    twins = Counter(key[:2] for key in keys)
    found = {}
    for method, preset, digest in keys:
        label = method if presets[method] == 1 else f"{method} [{preset}]"
        found[method, preset, digest] = label if twins[method, preset] == 1 else f"{label} {digest}"
    taken = Counter(found.values())
    # A method may be called what another one is labelled.
    return {key: label if taken[label] == 1 else f"{label} {key[2]}" for key, label in found.items()}


def comparable(group: Group) -> Group:
    """The part of `group` in which every entry ran on every scene: means over other scenes could not be compared.

    The scenes are those of one entry, or common to two, for which the number of entries that ran on all of them times
    the number of scenes is largest. Of more than `_MAX_SETS` sets of scenes, those of the most entries are considered.
    Controls are kept.
    """
    sets = Counter(frozenset(entry.scenes) for entry in group.entries)
    common = [scenes for scenes, _ in sorted(sets.items(), key=lambda item: (-item[1], sorted(item[0])))[:_MAX_SETS]]
    candidates = {a & b for a in common for b in common}

    def worth(scenes: frozenset[str]) -> tuple[int, int, list[str]]:
        count = sum(entries for other, entries in sets.items() if scenes <= other) if scenes else 0
        return count * len(scenes), count, sorted(scenes)

    chosen = max(candidates, key=worth, default=frozenset())
    kept = [
        Entry(entry.label, [result for result in entry.results if result.digests.scene in chosen])
        for entry in group.entries
        if chosen and chosen <= entry.scenes
    ]
    controls = [
        Entry(entry.label, [result for result in entry.results if result.digests.scene in chosen])
        for entry in group.controls
    ]
    return replace(group, entries=kept, controls=[entry for entry in controls if entry.results])
