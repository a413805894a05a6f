"""The examples of docs/other-agents.md run, shorter than printed, with Stable-Baselines3 and with plain PyTorch."""

import ast
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from bench import pendulum
from constraints import InUnits
from envs import Constrained

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "other-agents.md").read_text()
EXAMPLES = dict(re.findall(r"^## ([^\n]*)\n(?:(?!^## ).)*?```python\n(.*?)```", PAGE, re.DOTALL | re.MULTILINE))


def test_each_example_is_complete_python():
    assert set(EXAMPLES) == {
        "Stable-Baselines3",
        "A plain training loop",
        "TorchRL",
        "The tasks of this benchmark",
    }
    for code in EXAMPLES.values():
        assert ast.parse(code).body
        assert max(map(len, code.splitlines())) <= 120


def test_three_agents_of_stable_baselines3_never_exceed_the_limit(capsys):
    code = EXAMPLES["Stable-Baselines3"]
    shorter = code.replace("total_timesteps=4_000", "total_timesteps=250").replace(
        "env, seed=0",
        'env, **({"n_steps": 50, "batch_size": 50} if agent is PPO else {"learning_starts": 200}), seed=0',
    )
    assert shorter.count("250") == 1 and shorter.count("n_steps") == 1
    exec(compile(shorter, "Stable-Baselines3", "exec"), {"__name__": "example"})
    assert capsys.readouterr().out.splitlines() == [
        f"{name}: 0 of 250 steps too fast" for name in ("SAC", "TD3", "PPO")
    ]


def test_the_plain_loop_trains_within_its_power_limit(capsys):
    code = EXAMPLES["A plain training loop"]
    shorter = code.replace("= 3_000, 1_000, 256,", "= 1_020, 1_000, 16,")
    assert shorter != code
    names = {"__name__": "example"}
    exec(compile(shorter, "plain", "exec"), names)
    assert re.match(r"step 1000: return -?\d+\.\d, largest power 20\.0000\n", capsys.readouterr().out)
    obs, executed = names["replay"][:, :17], names["replay"][:, 17:23]
    power = np.abs(executed * obs[:, 11:17]).sum(-1)
    assert power.max() == pytest.approx(20.0, abs=1e-3) and (power > 19.9).mean() > 0.05


def test_the_tasks_of_this_benchmark_run_as_printed(capsys):
    exec(compile(EXAMPLES["The tasks of this benchmark"], "tasks", "exec"), {"__name__": "example"})
    assert re.match(r"\[[-.\d e]+\]\n", capsys.readouterr().out)


def test_the_picture_of_the_docs_has_the_training_that_never_exceeds_the_limit(tmp_path, capsys):
    out = tmp_path / "picture.png"
    assert pendulum.main(["steps=400", f"out={out}"]) == 0
    limited, free = capsys.readouterr().out.splitlines()
    assert limited.startswith("speed limit: 0 of 400 steps above 2.0 rad/s")
    assert re.match(r"no limit: [1-9]\d* of 400 steps above", free)
    assert out.stat().st_size > 10_000
    assert pendulum.main(["steps=10"]) == 2
    assert "bad value '10' for steps" in capsys.readouterr().err


def test_the_vector_environments_of_stable_baselines3_take_the_wrapper():
    constraint = InUnits(pendulum.SpeedLimit(dim=1), -2.0, 2.0)
    vector = make_vec_env(
        "Pendulum-v1", 2, env_kwargs={"g": 3.0}, wrapper_class=Constrained, wrapper_kwargs={"constraint": constraint}
    )
    SAC("MlpPolicy", vector, learning_starts=20, device="cpu").learn(40)
    vector.reset()
    infos = vector.step(np.ones((2, 1), np.float32))[3]
    assert all({"suggested_action", "executed_action", "violation"} <= info.keys() for info in infos)


def test_too_much_gravity_for_the_motor_is_an_error_and_no_violation():
    constraint = InUnits(_limit_with(gravity=15.0 * pendulum.STEP)(dim=1), -2.0, 2.0)
    env = Constrained(gymnasium.make("Pendulum-v1"), constraint)
    env.reset(seed=0, options={"x_init": 0.0, "y_init": 0.0})
    with pytest.raises(ValueError, match="the only sample"):
        for _ in range(200):
            obs = env.step(np.ones(1))[0]
            assert abs(obs[2]) <= pendulum.LIMIT + pendulum.ROUNDING


def _limit_with(gravity):
    class Limit(pendulum.SpeedLimit):
        def b(self, obs):
            return super().b(obs) + (pendulum.GRAVITY - gravity) * obs[..., 1:2] * obs.new_tensor([1.0, -1.0])

    return Limit
