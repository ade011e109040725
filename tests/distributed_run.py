"""What torchrun starts in tests/test_distributed.py: a short training, by this process or by several."""

import json
import os
import sys
import weakref
from pathlib import Path

import numpy as np
import torch
import torch.distributed as dist
from model_cases import make_case

import m3gn_bench.training
from m3gn_bench.distributed import ALONE, Group, torchrun_group
from m3gn_bench.errors import TrainingError
from m3gn_bench.model import load_preset
from m3gn_bench.tasks import get_task
from m3gn_bench.training import Progress, train

KIND = "deformable_block"
MODELS = ("m3gn", "mgn", "np_step")
STEPS = 8


def training(name: str, out: Path, group: Group = ALONE, kill_at: int | None = None) -> None:
    """Train on bodies of different size, three to a batch; the first process may die before the end."""
    task = get_task(KIND)

    def observe(progress: Progress) -> None:
        if progress.step == kill_at:
            os._exit(1)

    settings = {"training.steps": STEPS, "training.validations": 2, "training.batch_size": 3}
    train(
        load_preset(name, "smoke", task, settings),
        task,
        [make_case(KIND, seed, size=4 + seed % 2) for seed in range(5)],
        [make_case(KIND, seed) for seed in (10, 11)],
        out / name,
        seed=0,
        dataset_hash="none",
        group=group,
        observe=observe,
    )


def main(out: Path, what: str) -> None:
    torch.set_num_threads(1)
    with torchrun_group("cpu") as group:
        connection = weakref.ref(dist.group.WORLD)
        if what == "die":
            m3gn_bench.training.SAVE_INTERVAL = 0.0
            training(MODELS[0], out, group, kill_at=STEPS - 2)
        for name in MODELS:
            training(name, out, group)
        refused = False
        try:
            group.require_same(np.random.default_rng(group.rank))
        except TrainingError:
            refused = True
    found = {"size": group.size, "refused": refused, "ended": connection() is None}
    (out / f"{group.rank}.json").write_text(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
