"""Blocks on dask.distributed: the merged scene has the bytes of the serial run, even if processes are killed."""

import contextlib
import random
import shutil
import signal
import socket

import pytest

from block_runs import RECIPE
from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.locks import LOCK
from gsplat_edu.blocks.cluster import ClusterOptions, exposed, run_on_cluster
from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.blocks.status import statuses
from gsplat_edu.cli.main import main
from gsplat_edu.runs.blocks_folder import BlocksFolder
from processes import Program
from tiers import SEED
from waiting import PATIENCE, until

SCHEDULER = "from distributed.cli.dask_scheduler import main; main()"
WORKER = "from distributed.cli.dask_worker import main; main()"
COMMAND = "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"

WAITING_WORKER = """
import sys
from pathlib import Path
from distributed.cli.dask_worker import main
from gsplat_edu.runs.training import CaptureRun
from waiting import until

train, passed = CaptureRun.train, Path(sys.argv.pop(1))

def waiting(run, stop, callbacks=()):
    def wait(trainer, event):
        if trainer.iteration > 30:
            (passed / run.folder.path.name).touch()
            until(lambda: len(list(passed.iterdir())) < 4)

    return train(run, stop, [*callbacks, wait])

CaptureRun.train = waiting
main()
"""
"""A worker in which the last of four blocks to pass its 30th step waits, and any block that is not finished then.

It waits until the test kills it.
"""


def scene(folder):
    return (folder / "point_cloud" / "iteration_40" / "point_cloud.ply").read_bytes()


def free_port():
    """Return a port that no program uses, and that systems give to no program that asks for any: those lie higher."""
    while True:
        port = random.SystemRandom().randrange(20_000, 32_000)
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return port


class Cluster:
    """A scheduler and workers in processes of their own, on the loopback interface; leaving the context kills them."""

    def __init__(self, folder):
        self.folder, self.started = folder, 0
        self.processes = contextlib.ExitStack()
        self.port = free_port()
        self.address = f"tcp://127.0.0.1:{self.port}"

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.processes.close()

    def start(self, code, *words):
        self.started += 1
        place = self.folder / f"process_{self.started}"
        place.mkdir(parents=True)
        program = Program(code, words, place)
        self.processes.callback(kill, program)
        return program

    def scheduler(self):
        program = self.start(
            SCHEDULER,
            "--host",
            "127.0.0.1",
            "--port",
            self.port,
            "--no-dashboard",
            "--dashboard-address",
            "127.0.0.1:0",
        )
        until(lambda: answers(self.port))
        return program

    def worker(self, passed=None):
        """Start a worker; one that waits, if it is given a folder to note the blocks that passed their 30th step."""
        space = self.folder / f"space_{self.started}"
        code, words = (WORKER, ()) if passed is None else (WAITING_WORKER, (passed,))
        options = ("--no-nanny", "--nthreads", 1, "--no-dashboard", "--local-directory", space)
        return self.start(code, *words, self.address, *options)


def kill(program):
    if program.runs:
        program.send(signal.SIGKILL)
    program.process.join()


def answers(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.slow
def test_the_bytes_survive_a_killed_worker_and_a_killed_scheduler(city, split, serial, tmp_path):
    draw = random.Random(SEED)
    moments = sorted(draw.sample(range(5, 120), 2))  # a whole block is left
    run, passed = tmp_path / "run", tmp_path / "passed"
    shutil.copytree(split, run)
    passed.mkdir()
    plan, folder = BlockPlan.read(run), BlocksFolder(run)
    digest = plan.digest()

    def steps():
        return sum(status.iteration for status in statuses(folder, plan, digest))

    words = ["train", city, "--out", run, "--blocks", "4", *RECIPE, "--resume", "--scheduler"]
    with Cluster(tmp_path / "first") as cluster:
        scheduler = cluster.scheduler()
        workers = [cluster.worker(passed), cluster.worker(passed)]
        command = cluster.start(COMMAND, *words, cluster.address)
        until(lambda: steps() >= moments[0] or not command.runs)
        kill(draw.choice(workers))
        cluster.worker(passed)
        until(lambda: steps() >= moments[1] or not command.runs)
        kill(scheduler)
        code, _, err = command.ended()
        assert code == 2, f"moments {moments}: {err}"
        assert f"{cluster.address}: the scheduler was lost; finished blocks and checkpoints are kept" in err
        assert len(err.splitlines()) == 1
    finished = {n: folder.record(n).stat().st_mtime_ns for n in range(4) if folder.record(n).is_file()}
    assert len(finished) < 4, "the scheduler was killed before the blocks were finished"
    before = steps()
    assert before >= moments[0] - 20, (
        "each of two workers loses at most the 10 steps since its last checkpoint"
    )
    with Cluster(tmp_path / "second") as cluster:
        cluster.scheduler()
        for _ in range(2):
            cluster.worker()
        code, _, err = cluster.start(COMMAND, *words, cluster.address).ended()
        assert code == 0, err
    assert scene(run) == scene(serial), f"moments {moments}"
    assert {n: folder.record(n).stat().st_mtime_ns for n in finished} == finished, "trained once"


@pytest.mark.slow
def test_a_local_cluster_gives_the_same_bytes_and_names_the_missing_photo(city, split, serial, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(split, run)
    plan = BlockPlan.read(run)
    needs = {
        name: [i for i, block in enumerate(plan.blocks) if name in block.train] for name in names_of(plan)
    }
    name = min(needs, key=lambda name: (len(needs[name]), name))
    photo, away = city / "images" / name, city / f"away_{name}"
    photo.rename(away)
    words = ["train", city, "--out", run, "--blocks", "4", *RECIPE, "--resume", "--workers", "2"]
    try:
        code, _, err = Program(COMMAND, words, tmp_path).ended()
    finally:
        away.rename(photo)
    assert code == 2 and name in err and "missing here" in err
    assert f"{len(needs[name])} of 4 blocks failed; finished blocks and checkpoints are kept" in err
    folder, digest = BlocksFolder(run), plan.digest()
    assert [n for n in range(4) if folder.read_done(n, digest) is None] == needs[name], (
        "the other blocks are trained"
    )
    for number in needs[name]:
        assert main(["block", str(run), str(number)]) == 0
    assert main(["merge", str(run)]) == 0
    assert scene(run) == scene(serial)


def names_of(plan):
    return sorted({name for block in plan.blocks for name in block.train})


@pytest.mark.slow
def test_no_scheduler_no_workers_and_lost_workers_are_one_line(split, tmp_path):
    run = tmp_path / "run"
    shutil.copytree(split, run)
    lock = BlocksFolder(run).run(0).path / LOCK
    with Cluster(tmp_path / "cluster") as cluster:
        options = ClusterOptions(cluster.address, patience=2.0)
        with pytest.raises(ArgumentError, match=r"no scheduler answers at tcp://127\.0\.0\.1"):
            run_on_cluster(run, [0], options)
        cluster.scheduler()
        options = ClusterOptions(cluster.address, patience=20.0)
        with pytest.raises(CheckpointError, match=r"has no workers; start some with `dask worker ADDRESS`"):
            run_on_cluster(run, [0], options)
        worker = cluster.worker()
        import distributed

        with distributed.Client(cluster.address, timeout=PATIENCE, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=PATIENCE)

        def kill_the_worker_once_it_begins():
            if lock.exists() and worker.runs:
                kill(worker)

        with pytest.raises(CheckpointError, match="all workers were lost; start some, and finished blocks"):
            run_on_cluster(run, [0], options, watch=kill_the_worker_once_it_begins)


def test_a_network_without_tls_gets_a_warning():
    for safe in ("tcp://127.0.0.1:8786", "localhost:8786", "tls://10.0.0.5:8786"):
        assert exposed(safe) is None
    for open_to_others in ("tcp://10.0.0.5:8786", "host:8786"):
        assert "anyone who can connect can run programs" in exposed(open_to_others)


def test_main_without_a_scheduler_is_one_line(city, split, tmp_path, capsys):
    shutil.copytree(split, run := tmp_path / "run")
    words = ["train", str(city), "--out", str(run), "--blocks", "4", *RECIPE, "--resume"]
    assert main([*words, "--scheduler", "nowhere"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--scheduler: no scheduler answers at nowhere" in line
