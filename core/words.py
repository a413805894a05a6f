"""Words of a command line: `key=value`, lists of names, whole numbers, and the name that a misspelt one may mean."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Mapping


class ConfigError(ValueError):
    """A setting that the user can correct. The message is one line that names the value and the choices."""


def known_name(kind: str, value: object, choices: Iterable[str]) -> str:
    """Return `value` if it is one of `choices`. Otherwise raise a ConfigError that names them and the closest one."""
    choices, text = list(choices), str(value)
    if text in choices:
        return text
    by_folded = {choice.casefold(): choice for choice in choices}
    close = difflib.get_close_matches(text.casefold(), by_folded, n=1, cutoff=0.6)
    hint = f"; did you mean {by_folded[close[0]]}?" if close else ""
    raise ConfigError(f"unknown {kind} {text!r}{hint} (choices: {', '.join(choices)})")


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
    """Split a comma list of `choices` and of names of `groups`, each name once, in the order of the list.

    `all` is a group too: all of `choices`. Raises ConfigError for an unknown name.
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
        raise ConfigError(f"bad value {text!r} for {key}: expected whole numbers from {least} on")
    return int(number)


def whole_numbers(key: str, text: str) -> list[int]:
    """Parse a comma list of whole numbers from 1 on."""
    return [whole_number(key, part) for part in text.split(",")]
