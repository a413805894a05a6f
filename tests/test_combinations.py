"""Comma-separated values in a command: a cell for each combination of values."""

import pickle

import pytest
from helpers import cells_of, config_of, run_command, write_run

import plot
from core.config import RUN_KEYS, Config, split_values
from core.words import ConfigError
from plots.grouping import group_runs
from store.folder import find_runs, read_results

SHORT = "steps=24 learning_starts=16 batch_size=4 hidden=[8] eval_every=24 eval_episodes=1 final_episodes=1"


def variants(words):
    return [(cell.task, cell.variant) for cell in cells_of(words)]


@pytest.mark.parametrize(
    "key, text, values",
    [
        ("learning_rate", "1e-3,3e-4", ["1e-3", "3e-4"]),
        ("learning_rate", "1e-3", ["1e-3"]),
        ("train_freq", "episode,4", ["episode", "4"]),
        ("tau", "0.1,0.2,0.1", ["0.1", "0.2"]),
        ("hidden", "400,300", ["400,300"]),
        ("hidden", "[400,300]", ["[400,300]"]),
        ("hidden", "[64,64],[128]", ["[64,64]", "[128]"]),
        ("seed", "1,4,7", ["1,4,7"]),
        ("log", "csv,tensorboard", ["csv,tensorboard"]),
        ("results", "a,b", ["a,b"]),
    ],
)
def test_what_is_a_list_of_values(key, text, values):
    assert split_values(Config, key, text) == values


@pytest.mark.parametrize(
    "key, text, said",
    [
        ("learning_rate", "1e-3,", "a value between commas is empty"),
        ("tau", ",", "a value between commas is empty"),
        ("hidden", "[64,64],128", "expected one list (64,64) or several ([64,64],[128])"),
        ("hidden", "[64,64][128]", "expected one list"),
        ("hidden", "[[64],[128]]", "expected one list"),
        ("hidden", "[64,64", "expected one list"),
    ],
)
def test_lists_that_are_none(key, text, said, capsys):
    with pytest.raises(ConfigError) as error:
        split_values(Config, key, text)
    assert str(error.value).startswith(f"bad value {text!r} for {key}: {said}")
    assert run_command(["algo=DRad", "env=R+L2", f"{key}={text}"]) == 2
    assert capsys.readouterr().err == f"run.py: {error.value}\n"


@pytest.mark.parametrize(
    "words, said",
    [
        ("learning_rate=1e-3,x", "bad value 'x' for learning_rate: expected float"),
        ("learning_rate=1e-3,-1", "bad value -1.0 for learning_rate: must be positive"),
        ("hidden=[64],[x]", "bad value '[x]' for hidden"),
        ("threads=1,2", "bad value '1,2' for threads"),
        ("gsde=true,false", "gsde does not apply to DRad on R+L2"),
    ],
)
def test_each_value_is_checked_before_any_training(tmp_path, capsys, words, said):
    assert run_command(f"algo=DRad env=R+L2 {words} results={tmp_path}".split()) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and said in err and not list(tmp_path.iterdir())


def test_all_combinations_in_the_order_of_the_words():
    assert variants("algo=DRad,SRad env=R+L2,R+T learning_rate=1e-3,3e-4 batch_size=16,32") == [
        (task, f"{algo},batch_size={size}{rate}")
        for task in ("R+L2", "R+T")
        for algo, rates in {
            "DRad": ("", ",learning_rate=0.0003"),  # the paper's own value is not in the name
            "SRad": (",learning_rate=0.001", ",learning_rate=0.0003"),
        }.items()
        for rate in rates
        for size in (16, 32)
    ]
    assert variants("algo=DRad env=R+L2 hidden=[64,64],[400,300]") == [
        ("R+L2", "DRad,hidden=[64,64]"),
        ("R+L2", "DRad"),
    ]


def test_each_cell_comes_once():
    assert variants("algo=DRad env=R+L2 learning_rate=1e-3,0.001") == [("R+L2", "DRad")]
    # DRad lacks this setting, so it has one cell only.
    assert variants("algo=DRad,SRad env=R+L2 gsde=true,false") == [
        ("R+L2", "DRad"),
        ("R+L2", "SRad"),
        ("R+L2", "SRad,gsde=false"),
    ]


def test_a_cell_of_a_combination_is_started_by_its_own_words():
    """As a process of a queue (jobs=) and, pickled, as a Slurm job."""
    for cell in cells_of(
        "algo=SRad env=R+L2 seed=0-2 hidden=[8],[16,16] tau=0.1,0.2 train_freq=1,episode log=csv,wandb"
    ):
        assert config_of(cell.words).hidden == cell.config.hidden and config_of(cell.words).log == "csv,wandb"
        again = pickle.loads(pickle.dumps(cell))
        assert (again.variant, again.seeds, again.folders[0].name) == (cell.variant, (0, 1, 2), "seed=0")
        assert again.config.tau == cell.config.tau


def test_no_key_of_the_run_itself_makes_another_cell():
    """Folder names do not contain these keys, so several values would train the same run."""
    words = {"seed": "1,2", "results": "a,b", "log": "csv,wandb"}
    assert words.keys() <= set(RUN_KEYS)
    (cell,) = cells_of(["algo=DRad", "env=R+L2", *(f"{key}={text}" for key, text in words.items())])
    assert cell.seeds == (1, 2) and str(cell.root) == "a,b"


@pytest.mark.parametrize("more", ["", "jobs=2"])
def test_combinations_train_and_have_rows_and_figures_of_their_own(tmp_path, capsys, more):
    words = f"algo=DRad env=R+L2 {SHORT} tau=0.005,0.01 gamma=0.98,0.5 results={tmp_path} {more}"
    assert run_command([*words.split(), "dry=true"]) == 0
    assert "4 cells: 4 new" in capsys.readouterr().out and not list(tmp_path.rglob("seed=*"))
    assert run_command(words.split()) == 0
    assert len(find_runs(tmp_path)) == 4
    assert run_command([*words.split(), "dry=true"]) == 0
    assert "4 cells: 4 finished" in capsys.readouterr().out


def test_plots_name_the_combinations(tmp_path):
    for overrides in ({}, {"tau": 0.01}, {"gamma": 0.5}, {"gamma": 0.5, "tau": 0.01}):
        write_run(tmp_path, "R+L2", "DRad", 0, result=1.0, overrides=overrides).append_statistics(5_000, {"loss": 1.0})
    groups, _ = group_runs(read_results(tmp_path)[0])
    labels = ["R+L2", "R+L2, gamma=0.5", "R+L2, gamma=0.5, tau=0.01", "R+L2, tau=0.01"]
    assert sorted(condition.label for condition in groups) == labels
    assert plot.main([str(tmp_path), "format=png,csv"]) == 0
    figures = {path.stem for path in (tmp_path / "figures").iterdir()}
    assert {label.replace(", ", ",") for label in labels} | {"R+L2-training"} <= figures
