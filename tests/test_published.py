"""Published runs: equal to their folders in every bit; what must not be published is refused."""

import gzip
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from synthetic import write_results

from bench.publish import main
from store.folder import read_results, read_run
from store.published import PublishedRun, published_cells, read_published, write_published

COMMIT = "0123456789012345678901234567890123456789"


@pytest.fixture
def results(tmp_path):
    """Two seeds of SRad and of DPre on R+L2, finished, from a clean commit."""
    root = tmp_path / "results"
    write_results(root, [("R+L2", "default")], ("DPre", "SRad"), seeds=2)
    for folder in root.glob("*/*/seed=*"):
        result = json.loads((folder / "result.json").read_text())
        (folder / "result.json").write_text(json.dumps(result | {"steps": 300_000, "best_step": 60_000}))
        (folder / "info.json").write_text(json.dumps({"commit": COMMIT, "dirty": False}))
    return root


def contents(run):
    return {
        "names": (run.task, run.algo, run.variant, run.overrides, run.seed),
        "config": run.config,
        "evaluations": {name: values.tolist() for name, values in run.evaluations._asdict().items()},
        "training": {name: values.tolist() for name, values in run.training.items()},
        "end": (run.result, run.failure),
    }


def publish(root, out, *words):
    return main([str(root), f"out={out}", *words])


def test_published_runs_equal_their_folders(results, tmp_path, capsys):
    out = tmp_path / "data"
    assert publish(results, out) == 0
    assert capsys.readouterr().out.count("finished") == 4
    folders, problems = read_results(results)
    published = [published.run for published in read_published(out)]
    assert len(folders) == 4 and not problems
    assert [contents(run) for run in folders] == [contents(run) for run in published]
    assert all(p.info == {"commit": COMMIT, "dirty": False} for p in read_published(out))
    assert published_cells(out) == [("R+L2", "DPre"), ("R+L2", "SRad")]
    assert {run.run.algo for run in read_published(out, algos=["SRad"])} == {"SRad"}
    assert read_published(out, tasks=["W+M"]) == []


def test_the_same_runs_make_the_same_files(results, tmp_path):
    assert publish(results, tmp_path / "one") == publish(results, tmp_path / "two", "algo=SRad") == 0
    assert publish(results, tmp_path / "two") == 0
    for file in (tmp_path / "one" / "R+L2").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / "R+L2" / file.name).read_bytes()


def test_no_training_rows_of_replaced_runs_stay(results, tmp_path):
    assert publish(results, tmp_path) == 0
    folder, published = tmp_path / "R+L2", read_published(tmp_path)
    training = {"step": np.array([1000]), "critic_loss": np.array([0.5])}
    write_published(folder, [replace(p, run=replace(p.run, training=training)) for p in published])
    assert [p.run.training for p in read_published(tmp_path)] == [training] * 4
    write_published(folder, [replace(p, run=replace(p.run, training={})) for p in published])
    assert [p.run.training for p in read_published(tmp_path)] == [{}] * 4
    assert not (folder / "training.csv.gz").exists()


def test_rows_of_evaluations_may_have_any_order(results, tmp_path):
    assert publish(results, tmp_path) == 0
    before = [contents(p.run) for p in read_published(tmp_path)]
    path = tmp_path / "R+L2" / "evaluations.csv.gz"
    header, *rows = gzip.decompress(path.read_bytes()).decode().splitlines()
    rows.sort(key=lambda row: int(row.split(",")[3]))
    path.write_bytes(gzip.compress("\n".join([header, *rows]).encode()))
    assert [contents(p.run) for p in read_published(tmp_path)] == before


def test_a_diverged_run_has_the_result_of_its_best_parameters(results, tmp_path):
    folder = results / "R+L2" / "DPre" / "seed=0"
    (folder / "result.json").unlink()
    failure = {"step": 300_000, "quantity": "actor loss", "result": {"return_mean": 3.5, "best_step": 5_000}}
    for result, expected in (
        (failure["result"], ("3.5", "5000")),
        ("final evaluation: refused", ("", "")),
        (None, ("", "")),
    ):
        (folder / "failed.json").write_text(json.dumps(failure | {"result": result}))
        out = tmp_path / str(expected[0] or result)
        assert publish(results, out) == 0
        published = next(p for p in read_published(out) if p.key == ("DPre", "DPre", 0))
        assert published.state == "failed" and published.run.failure["result"] == result
        row = next(row for row in (out / "R+L2" / "runs.csv").read_text().splitlines() if row.startswith("DPre,DPre,0"))
        assert row.split(",")[3:6] == ["failed", *expected]


def cut(path):
    path.write_bytes(path.read_bytes()[:-20])


def swapped(old, new):
    def swap(path):
        text = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
        assert old in text
        changed = text.replace(old, new, 1).encode()
        path.write_bytes(gzip.compress(changed) if path.suffix == ".gz" else changed)

    return swap


@pytest.mark.parametrize(
    "name, spoil",
    [
        ("evaluations.csv.gz", cut),
        ("evaluations.csv.gz", lambda path: path.write_text("no gzip")),
        (
            "evaluations.csv.gz",
            lambda path: path.write_bytes(path.read_bytes()[:20] + b"?????" + path.read_bytes()[25:]),
        ),
        ("evaluations.csv.gz", swapped("step", "stop")),
        ("training.csv.gz", lambda path: path.write_bytes(gzip.compress(b"algo,variant,seed,step\nSRad,SRad,0,x\n"))),
        ("runs.csv", swapped("state", "stage")),
        ("runs.csv", swapped("DPre,DPre,0", "DPre,DPre,zero")),
        ("runs.csv", swapped("DPre,DPre,1,", "DPre,DPre,1,,,,,")),
        ("runs.csv", swapped(",finished,", ",finished\nDPre,DPre,7,")),
        ("runs.csv", swapped('{""algo""', '{""algo')),
        ("runs.csv", lambda path: path.write_text("")),
        ("runs.csv", lambda path: path.unlink()),
        ("runs.csv", swapped(f",60000,{COMMIT}", f",60000,{'4' * 40}")),
        ("runs.csv", swapped(",finished,", ",stopped,")),
        ("runs.csv", swapped(",finished,", ",failed,")),
        ("runs.csv", lambda path: path.write_text(path.read_text() + path.read_text().splitlines()[-1])),
        ("evaluations.csv.gz", lambda path: path.unlink()),
        ("evaluations.csv.gz", swapped("SRad,SRad,1,300000,", "SRad,SRad,7,300000,")),
        ("evaluations.csv.gz", swapped("SRad,SRad,1,300000,", "SRad,SRad,1,299999,")),
    ],
)
def test_a_corrupt_file_is_named(results, tmp_path, capsys, name, spoil):
    assert publish(results, tmp_path / "data") == 0
    spoil(tmp_path / "data" / "R+L2" / name)
    with pytest.raises(ValueError, match=name):
        read_published(tmp_path / "data")
    capsys.readouterr()
    assert publish(results, tmp_path / "data") == 2
    assert name in capsys.readouterr().err


def test_a_folder_of_another_task_is_refused(results, tmp_path):
    assert publish(results, tmp_path / "data") == 0
    shutil.copytree(tmp_path / "data" / "R+L2", tmp_path / "data" / "R+M")
    with pytest.raises(ValueError, match=r"R\+M.*DPre DPre 0: its task is R\+L2$"):
        read_published(tmp_path / "data")


def test_a_place_that_cannot_be_written_is_one_line(results, tmp_path, capsys):
    (tmp_path / "file").touch()
    assert publish(results, tmp_path / "file") == 2
    assert f"publish.py: {tmp_path / 'file'}" in capsys.readouterr().err


def test_failed_and_stopped_runs_keep_their_state(results, tmp_path):
    failed, stopped = sorted(results.glob("R+L2/DPre/seed=*"))
    (failed / "result.json").unlink()
    (failed / "failed.json").write_text(json.dumps({"step": 7, "quantity": "actor loss is not finite"}))
    (stopped / "result.json").unlink()
    runs = [PublishedRun(read_run(folder), {}) for folder in (failed, stopped)]
    write_published(tmp_path / "data" / "R+L2", runs)
    published = read_published(tmp_path / "data")
    assert [run.state for run in published] == ["failed", "stopped"]
    assert published[0].run.failure == {"step": 7, "quantity": "actor loss is not finite"}
    assert np.array_equal(published[1].run.evaluations.returns, runs[1].run.evaluations.returns)


def unfinished(folder):
    (folder / "result.json").unlink()


def edited(name, change):
    def edit(folder):
        path = folder / name
        parse, write = (yaml.safe_load, yaml.safe_dump) if name.endswith("yaml") else (json.loads, json.dumps)
        path.write_text(write(parse(path.read_text()) | change))

    return edit


def without(name, key):
    def remove(folder):
        path = folder / name
        parse, write = (yaml.safe_load, yaml.safe_dump) if name.endswith("yaml") else (json.loads, json.dumps)
        content = parse(path.read_text())
        del content[key]
        path.write_text(write(content))

    return remove


def without_the_last_evaluation(folder):
    path = folder / "evaluations.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))


REFUSED = {
    "it has not ended": unfinished,
    "info.json: no such file": lambda folder: (folder / "info.json").unlink(),
    "info.json: Expecting value": lambda folder: (folder / "info.json").write_text(""),
    "info.json: 'list' object": lambda folder: (folder / "info.json").write_text("[]"),
    "info.json: no 'dirty'": edited("info.json", {"sources": [{"file": "my.py", "commit": COMMIT}]}),
    "no 'steps'": without("result.json", "steps"),
    "seed=1: ": without("config.yaml", "env"),
    "its evaluations do not reach step 300000": without_the_last_evaluation,
    "it has result.json and failed.json": lambda folder: (folder / "failed.json").write_text(
        '{"step": 7, "quantity": "actor loss"}'
    ),
    "its commit is not known": edited("info.json", {"commit": None}),
    "uncommitted changes": edited("info.json", {"dirty": True}),
    "uncommitted": edited("info.json", {"resumed": [{"commit": COMMIT, "dirty": True}]}),
    "mine.py, of which no commit has that content": edited(
        "info.json", {"sources": [{"file": "mine.py", "commit": None, "dirty": None}]}
    ),
    "my.py, of which": edited("info.json", {"sources": [{"file": "my.py", "commit": COMMIT, "dirty": True}]}),
    "different commits": edited("info.json", {"resumed": [{"commit": "4" * 40, "dirty": False}]}),
    "its config.yaml DPre,batch_size=7": edited("config.yaml", {"batch_size": 7}),
    "its config.yaml R+M": edited("config.yaml", {"env": "R+M"}),
    "its folder says (1,)": edited("config.yaml", {"seed": "3"}),
    "it has 5 steps of 300000": edited("result.json", {"steps": 5}),
}


@pytest.mark.parametrize("reason", REFUSED)
def test_a_refused_run_keeps_its_whole_cell_back(results, tmp_path, capsys, reason):
    REFUSED[reason](results / "R+L2" / "DPre" / "seed=1")
    assert publish(results, tmp_path / "data") == 1
    errors = capsys.readouterr().err
    assert "DPre/seed=1" in errors and reason in errors
    assert "DPre/seed=0: another seed of its cell is refused" in errors
    assert [run.key for run in read_published(tmp_path / "data")] == [("SRad", "SRad", 0), ("SRad", "SRad", 1)]


def test_runs_with_other_settings_than_the_papers_are_published_for_the_asking_alone(results, tmp_path, capsys):
    other = results / "R+L2" / "SRad,gamma=0.5"
    (results / "R+L2" / "SRad").rename(other)
    for seed in (0, 1):
        edited("config.yaml", {"gamma": 0.5})(other / f"seed={seed}")
    assert publish(results, tmp_path / "data") == 1
    assert "its settings are not the paper's: gamma=0.5 (settings=any publishes it)" in capsys.readouterr().err
    assert {run.run.algo for run in read_published(tmp_path / "data")} == {"DPre"}
    assert publish(results, tmp_path / "data", "settings=any") == 0
    assert {run.run.algo for run in read_published(tmp_path / "data")} == {"DPre", "SRad"}
    assert publish(results, tmp_path / "data", "settings=all") == 2


def test_a_run_of_an_algorithm_of_ones_own_is_named(results, tmp_path, capsys):
    (results / "R+L2" / "SRad").rename(results / "R+L2" / "Mine")
    for seed in (0, 1):
        edited("config.yaml", {"algo": "Mine"})(results / "R+L2" / "Mine" / f"seed={seed}")
    assert publish(results, tmp_path / "data") == 1
    assert "unknown algorithm or task, Mine on R+L2" in capsys.readouterr().err


def test_a_published_run_is_not_replaced_and_other_seeds_of_its_cell_come_beside_it(results, tmp_path, capsys):
    out, other = tmp_path / "data", tmp_path / "other"
    shutil.copytree(results, other)
    shutil.rmtree(other / "R+L2" / "SRad" / "seed=1")
    assert publish(other, out) == 0
    before = {run.key: run.row() for run in read_published(out)}
    edited("result.json", {"return_mean": 99.0})(results / "R+L2" / "SRad" / "seed=0")
    capsys.readouterr()
    assert publish(results, out) == 1
    printed = capsys.readouterr()
    assert "SRad/seed=0: another run of this seed is published already" in printed.err
    assert "R+L2 SRad seed 1" in printed.out
    after = {run.key: run.row() for run in read_published(out)}
    assert before.items() <= after.items() and after.keys() - before.keys() == {("SRad", "SRad", 1)}


def test_a_published_run_is_not_replaced(results, tmp_path, capsys):
    out = tmp_path / "data"
    assert publish(results, out) == 0
    before = (out / "R+L2" / "runs.csv").read_bytes()
    capsys.readouterr()
    assert publish(results, out) == 0
    assert capsys.readouterr().out == "nothing new to publish\n"
    edited("result.json", {"return_mean": 99.0})(results / "R+L2" / "SRad" / "seed=0")
    assert publish(results, out) == 1
    assert "published already" in capsys.readouterr().err
    assert (out / "R+L2" / "runs.csv").read_bytes() == before


@pytest.mark.parametrize(
    "words, message",
    [
        (["nowhere"], "nowhere is not a folder"),
        (["{results}", "algo=SRat"], "did you mean SRad?"),
        (["{results}", "env=W+M"], "no runs of these tasks"),
        (["{results}/R+L2"], "no runs in"),
        (["{results}", "to=x"], "unknown key 'to'"),
    ],
)
def test_wrong_words_are_refused(results, tmp_path, capsys, words, message):
    assert main([word.format(results=results) for word in words]) == 2
    assert message in capsys.readouterr().err
