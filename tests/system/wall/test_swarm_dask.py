"""Campaigns on a cluster of dask: two workers on this machine."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from motorhil.harness import examples
from motorhil.harness.rig.config.toml import RigError
from motorhil.harness.swarm.campaign import Campaign, with_profile
from motorhil.harness.swarm.engine import dask, end_workers, local
from motorhil.harness.swarm.plan import FUNCTION, Program, plan_of
from motorhil.harness.swarm.results import create, open_results
from motorhil.traces.mcap.reader import read_trace
from tests.support.command_line import in_another_process
from tests.support.swarm import clusters

pytestmark = pytest.mark.wall
pytest.importorskip("distributed", reason="motorhil[dask] is not installed")

PROGRAM = """\
import os


def calm(rig):
    rig.runtime.run_for(0.01)


def failing(rig):
    calm(rig)
    assert rig.seed < 3 or os.getcwd() == "/", "too many"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return a folder with a rig and its program, where the tests run."""
    home = tmp_path_factory.mktemp("cluster")
    source = Path(examples.__file__).parent
    shutil.copy(source / "wheel_model.toml", home)
    shutil.copy(source / "two_wheels.toml", home / "rig.toml")
    (home / "app.py").write_text(PROGRAM)
    before = Path.cwd()
    os.chdir(home)
    yield home
    end_workers()
    os.chdir(before)


@pytest.fixture
def cluster(folder):
    """Return the address of a scheduler with two workers, and its process."""
    with clusters.cluster(2) as begun:
        yield begun


@pytest.fixture(scope="module")
def plan(folder):
    return with_profile(plan_of(Path("rig.toml"), Program(FUNCTION, "app:calm"), (), 60.0))


def lines(folder):
    return sorted((folder / "rows.jsonl").read_text().splitlines())


def test_cluster_gives_the_rows_of_one_machine(folder, plan, cluster):
    address, _ = cluster
    engine = dask(address)
    Campaign(plan, create(folder / "cluster", plan), engine, 2).run(range(40), lambda rows: None)
    engine.shutdown()
    with local(1) as one:
        Campaign(plan, create(folder / "local", plan), one, 1).run(range(40), lambda rows: None)
        end_workers()
    assert len(lines(folder / "cluster")) == 40
    assert lines(folder / "cluster") == lines(folder / "local")


def test_scheduler_that_is_killed_is_told_and_resumed(folder, plan, cluster):
    address, scheduler = cluster
    results = create(folder / "killed", plan)
    engine = dask(address)
    with pytest.raises(RigError, match=r"the engine is gone|workers have died") as raised:
        Campaign(plan, results, engine, 2).run(range(40), lambda rows: scheduler.kill())
    engine.shutdown()
    assert "--resume" in str(raised.value)
    _, again = open_results(folder / "killed")
    assert 0 < len(again.rows) < 40
    with local(1) as one:
        Campaign(plan, again, one, 1).run(range(40), lambda rows: None)
        Campaign(plan, create(folder / "whole", plan), one, 1).run(range(40), lambda rows: None)
        end_workers()
    assert lines(folder / "killed") == lines(folder / "whole")


def test_worker_of_another_build_is_refused(folder, plan, cluster):
    address, _ = cluster
    engine = dask(address)
    other = replace(plan, build="another build")
    with pytest.raises(RigError, match=r"a worker refuses: .*another build"):
        Campaign(other, create(folder / "other", plan), engine, 2).run(range(4), lambda rows: None)
    engine.shutdown()


def test_scheduler_that_does_not_answer_is_told():
    with pytest.raises(RigError, match="no scheduler answers"):
        dask(f"127.0.0.1:{clusters.free_port()}")


def test_records_come_to_the_campaign(folder, cluster, tmp_path):
    address, _ = cluster
    words = ("swarm", "rig.toml", "app:failing", "--seeds", "4", "--no-shrink", "--workers", "2")
    done = in_another_process(*words, "--engine", f"dask={address}", "-o", str(tmp_path / "out"))
    assert done.returncode == 1, done.stderr
    (record,) = (tmp_path / "out/failures").glob("*.mcap")
    assert record.stat().st_mode & clusters.WORKERS_UMASK  # a worker may be another machine
    with read_trace(record) as trace:
        assert trace.span_ns()[1] > 0
