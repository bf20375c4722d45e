"""Ready files of docs/how-to/run-a-swarm.md for machines that are not here."""

import re
import shlex
import subprocess

import pytest
import yaml

from motorhil.harness.cli.main import parsers
from motorhil.harness.swarm.campaign import checked_part
from motorhil.harness.swarm.lanes import LANES
from tests.architecture.pages import shown_file

GITHUB, KUBERNETES, SLURM = "swarm.yml", "swarm-job.yaml", "swarm.sbatch"


def steps(job):
    return [step["run"] for step in job["steps"] if "run" in step]


def pod():
    job = yaml.safe_load(shown_file(KUBERNETES).text)
    (container,) = job["spec"]["template"]["spec"]["containers"]
    return job, container


def commands():
    """Return each `motorhil swarm` of the files, with values in place of variables."""
    jobs = yaml.safe_load(shown_file(GITHUB).text)["jobs"]
    texts = [*steps(jobs["part"]), *steps(jobs["page"]), *pod()[1]["args"], shown_file(SLURM).text]
    for text in texts:
        text = text.replace("$resume", "--resume")
        plain = re.sub(r"\$\{\{.*?\}\}|\$\{\w+:-(\d+)\}|\$\w+", lambda found: found[1] or "3", text)
        for line in plain.replace("\\\n", " ").splitlines():
            if line.strip().startswith("motorhil swarm"):
                yield shlex.split(line)[2:]


def test_commands_of_ready_files_can_be_parsed():
    parser = parsers()["swarm"]
    found = [parser.parse_intermixed_args(words) for words in commands()]
    assert len(found) == 4
    assert [one.engine for one in found] == ["index=3/4", "local", "index=3/16", "index=3/3"]
    assert str(found[1].show) == "swarm"


def test_github_matrix_has_all_parts():
    jobs = yaml.safe_load(shown_file(GITHUB).text)["jobs"]
    parts = jobs["part"]["strategy"]["matrix"]["part"]
    text = next(step for step in steps(jobs["part"]) if "swarm" in step)
    count = re.search(r"matrix\.part \}\}/(\d+)", text)[1]
    assert [checked_part(f"{part}/{count}")[0] for part in parts] == list(range(1, int(count) + 1))
    assert jobs["page"]["needs"] == "part"


def test_kubernetes_job_has_all_parts():
    job, container = pod()
    spec = job["spec"]
    assert (job["apiVersion"], job["kind"], spec["completionMode"]) == (
        "batch/v1",
        "Job",
        "Indexed",
    )
    count = int(re.search(r"index=\$part/(\d+)", container["args"][0])[1])
    assert spec["completions"] == count <= LANES
    mounted = {one["name"] for one in container["volumeMounts"]}
    assert mounted == {one["name"] for one in spec["template"]["spec"]["volumes"]}


@pytest.mark.parametrize("text", [pod()[1]["args"][0], shown_file(SLURM).text])
def test_shell_scripts_can_be_parsed(text):
    done = subprocess.run(["sh", "-n"], input=text, text=True, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
