"""A line of help for each setting of a method: from its field's description, its class's docstring, or its comments.

A method's author writes what suits: `Field(description=...)`, an entry `name: text.` under `Attributes:`, lines of `#:`
above a field, or a comment behind it.
"""

from __future__ import annotations

import inspect
import re
import textwrap

from splashbench.harness.contract import MethodConfig

_FIELD = re.compile(r"^    (\w+):[^#]*(?:#(?!:)\s*(.*))?$")
_NAMES = re.compile(r"(?:(?<=^)|(?<=[.;]\s))(\w+(?:, \w+)*): ")


def settings_help(config: type[MethodConfig]) -> dict[str, str]:
    """Setting -> what it is, in one line of any length, for those of which something is said."""
    found: dict[str, str] = {}
    for part in reversed(config.__mro__):
        if part is not MethodConfig and isinstance(part, type) and issubclass(part, MethodConfig):
            found |= _of_docstring(inspect.cleandoc(part.__doc__ or ""), part)
            found |= _of_comments(part)
    for name, field in config.model_fields.items():
        if field.description:
            found[name] = " ".join(field.description.split())
    said = {name: (found.get(name) or _aside(name, found)).rstrip(" ;,") for name in config.model_fields}
    return {name: text for name, text in said.items() if text}


def _aside(name: str, found: dict[str, str]) -> str:
    """What another setting's help says of `name` by the way; "" where none does."""
    return next((said for said in found.values() if re.search(rf"\b{name}\b", said)), "")


def _of_docstring(text: str, part: type[MethodConfig]) -> dict[str, str]:
    """Entries `name, other: text` under "Attributes:", which may stand in one line one after the other."""
    entries = " ".join(textwrap.dedent(text.partition("Attributes:")[2]).split())
    places = [match for match in _NAMES.finditer(entries) if set(match[1].split(", ")) <= set(part.model_fields)]
    found: dict[str, str] = {}
    for match, after in zip(places, [*places[1:], None]):
        said = entries[match.end() : after.start() if after else len(entries)].strip()
        found |= dict.fromkeys(match[1].split(", "), said)
    return found


def _of_comments(part: type[MethodConfig]) -> dict[str, str]:
    """Lines of `#:` above a field, else what stands behind it; nothing where the source is not at hand."""
    try:
        lines = inspect.getsource(part).splitlines()
    except (OSError, TypeError):
        return {}
    found: dict[str, str] = {}
    above: list[str] = []
    for line in lines:
        if line.strip().startswith("#:"):
            above.append(line.strip()[2:].strip())
            continue
        field = _FIELD.match(line)
        if field and field[1] in part.model_fields:
            said = " ".join(above) or (field[2] or "").removeprefix("noqa").strip()
            if said:
                found[field[1]] = said
        above = []
    return found
