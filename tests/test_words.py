"""Words of a command line (core/words.py): `key=value`, names from a list, whole numbers."""

import pytest

from core.words import ConfigError, known_name, parse_words, split_names, whole_number, whole_numbers

COLOURS = ["red", "green", "Blue"]


def test_words_become_a_dict_in_their_order():
    assert parse_words(["b=2", "a=x=y"], ["a", "b"]) == {"b": "2", "a": "x=y"}
    assert list(parse_words(["b=2", "a=1"], ["a", "b"])) == ["b", "a"]
    assert parse_words(["a=1", "my.own=2"], ["a"], free="my.") == {"a": "1", "my.own": "2"}


@pytest.mark.parametrize(
    "words, said",
    [
        (["a"], "expected key=value, got 'a'"),
        (["a="], "expected key=value, got 'a='"),
        (["my.=1"], "expected key=value, got 'my.=1'"),
        (["colr=1"], "unknown key 'colr'; did you mean color? (choices: a, color)"),
        (["zzz=1"], "unknown key 'zzz' (choices: a, color)"),
        (["a=1", "a=2"], "key 'a' given twice: '1' and '2'"),
    ],
)
def test_wrong_words(words, said):
    with pytest.raises(ConfigError) as error:
        parse_words(words, ["a", "color"], free="my.")
    assert str(error.value) == said


def test_lists_of_names():
    assert split_names("colour", "green,red,green", COLOURS) == ["green", "red"]
    assert split_names("colour", "all", COLOURS) == COLOURS
    warm = {"warm": ["red"], "none": ()}
    assert split_names("colour", "Blue,warm", COLOURS, warm) == ["Blue", "red"]
    assert split_names("colour", "green,all", COLOURS, warm) == ["green", "red", "Blue"]
    assert split_names("colour", "none", COLOURS, warm) == []
    with pytest.raises(
        ConfigError, match=r"unknown colour 'blue'; did you mean Blue\? \(choices: red, green, Blue, warm"
    ):
        split_names("colour", "blue", COLOURS, warm)


def test_a_name_that_resembles_no_other_gets_no_hint():
    assert known_name("colour", "red", COLOURS) == "red"
    with pytest.raises(ConfigError) as error:
        known_name("colour", 7, COLOURS)
    assert str(error.value) == "unknown colour '7' (choices: red, green, Blue)"


def test_of_many_names_the_one_meant_is_enough():
    names = [f"name{i}" for i in range(30)] + ["colour"]
    with pytest.raises(ConfigError) as error:
        known_name("key", "color", names)
    assert str(error.value) == "unknown key 'color'; did you mean colour?"
    with pytest.raises(ConfigError, match="choices: name0, name1, "):
        known_name("key", "xyz", names)


def test_whole_numbers():
    assert (whole_number("n", "3e5"), whole_number("n", "007"), whole_number("n", "0", least=0)) == (300_000, 7, 0)
    assert whole_numbers("n", "1,2e1") == [1, 20]
    for text in ("0", "-1", "1.5", "x", "", "nan", "inf"):
        with pytest.raises(ConfigError, match="for n: expected a whole number of at least 1"):
            whole_number("n", text)
