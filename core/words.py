"""The words of a command line: `key=value`, lists of names, whole numbers, and suggestions for misspelt names."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, MutableMapping
from typing import TypeVar

Row = TypeVar("Row")
FEW = 20
"""A message that suggests a name also lists all choices, unless there are more than this."""
GROUPS = ("all", "paper")
"""Words on a command line that stand for several names."""


class ConfigError(ValueError):
    """A mistake that the user can correct. The message is one line that names the value and the choices."""


class NameTable(MutableMapping[str, Row]):
    """A mapping whose keys are names on command lines and in run folders; `kind`, such as "task", is for messages.

    Raises ValueError for a name that is taken, because it identifies runs, and for a name that cannot be used as a
    word, in a comma list and in a folder's name. `del` frees a name.
    """

    def __init__(self, kind: str):
        self.kind, self._rows = kind, dict[str, Row]()

    def __setitem__(self, name: str, row: Row) -> None:
        self.check_free(name)
        if not isinstance(name, str) or not re.fullmatch(r"[^\s,/\\=.][^\s,/\\=]*", name) or name in GROUPS:
            article = "an" if self.kind[0] in "aeiou" else "a"
            raise ValueError(
                f"{name!r} cannot be the name of {article} {self.kind}: a name has no space, comma, '=' or slash, does"
                f" not begin with '.', and is not one of the words {', '.join(map(repr, GROUPS))}"
            )
        self._rows[name] = row

    def check_free(self, name: str) -> None:
        """Raise ValueError if there is a row `name`."""
        if name in self._rows:
            raise ValueError(f"the {self.kind} {name!r} exists already: choose another name, or delete it first")

    def __repr__(self) -> str:
        return repr(self._rows)

    def __ior__(self, rows: Mapping[str, Row]) -> NameTable[Row]:
        self.update(rows)
        return self

    def __getitem__(self, name: str) -> Row:
        return self._rows[name]

    def __delitem__(self, name: str) -> None:
        del self._rows[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._rows)

    def __len__(self) -> int:
        return len(self._rows)


def known_name(kind: str, value: object, choices: Iterable[str]) -> str:
    """Return `value` if it is one of `choices`; otherwise raise a ConfigError.

    The message names the closest choice, if one is similar. It lists all choices if none is similar, or if they are at
    most `FEW`.
    """
    choices, text = list(choices), str(value)
    if text in choices:
        return text
    close = closest(text, choices)
    hint = f"; did you mean {close}?" if close else ""
    listed = f" (choices: {', '.join(choices)})" if not close or len(choices) <= FEW else ""
    raise ConfigError(f"unknown {kind} {text!r}{hint}{listed}")


def closest(text: str, choices: Iterable[str]) -> str | None:
    """The name in `choices` that a misspelt `text` may mean; None if no name is similar."""
    by_folded = {choice.casefold(): choice for choice in choices}
    close = difflib.get_close_matches(text.casefold(), by_folded, n=1, cutoff=0.6)
    return by_folded[close[0]] if close else None


def parse_words(words: Iterable[str], keys: Iterable[str], free: str | None = None) -> dict[str, str]:
    """Parse `key=value` words into a dict, in their order. Every key is one of `keys`, or begins with `free`.

    Raises ConfigError for a word of another form, an unknown key, and a key that is given twice.
    """
    keys = list(keys)
    settings: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not value or key == free:
            raise ConfigError(f"expected key=value, got {word!r}")
        if free is None or not key.startswith(free):
            known_name("key", key, keys)
        if key in settings:
            raise ConfigError(f"key {key!r} given twice: {settings[key]!r} and {value!r}")
        settings[key] = value
    return settings


def split_names(
    kind: str, value: str, choices: Iterable[str], groups: Mapping[str, Collection[str]] | None = None
) -> list[str]:
    """Split a comma list into names out of `choices`, each once, in the order of the list.

    The list may also name groups, which stand for their members; `all` stands for all `choices`. Raises ConfigError for
    an unknown name.
    """
    choices = list(choices)
    groups = {**(groups or {}), "all": choices}
    wanted: dict[str, None] = {}
    for name in value.split(","):
        known_name(kind, name, [*choices, *groups])
        wanted |= dict.fromkeys(groups.get(name, (name,)))
    return list(wanted)


def whole_number(key: str, text: str, least: int = 1) -> int:
    """Parse a whole number of at least `least`, which may be written as 3e5. Raises ConfigError for anything else."""
    try:
        number = float(text)
    except ValueError:
        number = float("nan")
    if not number.is_integer() or number < least:
        raise ConfigError(f"bad value {text!r} for {key}: expected a whole number of at least {least}")
    return int(number)


def whole_numbers(key: str, text: str) -> list[int]:
    """Parse a comma list of whole numbers from 1 on."""
    return [whole_number(key, part) for part in text.split(",")]
