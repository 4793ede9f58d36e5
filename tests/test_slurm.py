"""Workers on a real Slurm: one node on the loopback, in a temporary folder."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest
import sqlalchemy as sa
from conftest import python, until
from studies_synthetic import swept, threshold_study, unhurried

from kerv_cli.base.config import compose
from kerv_cli.episodes.settings import RolloutSettings
from kerv_cli.lab.database import EPISODES, UNFINISHED, WANTED, opened
from kerv_cli.lab.store import Study, counts_of
from kerv_cli.lab.work import Counted

STUDY = threshold_study(["reach-v3", "push-v3"], episodes=6, radii=(3,), block=2)
CONFIGURATION = """
ClusterName=kerv
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket,cred_expire=5
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
ReturnToService=2
SchedulerParameters=sched_interval=1,batch_sched_delay=0
KillWait=5
MpiDefault=none
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=4000 State=UNKNOWN
PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@pytest.fixture(scope="module")
def slurm():
    """Start a Slurm of one node, and let this process use it."""
    if not all(shutil.which(name, path="/usr/sbin:/usr/bin") for name in ("munged", "slurmctld", "slurmd", "sbatch")):
        pytest.skip("no Slurm here: apt-get install slurmctld slurmd slurm-client munge")
    with tempfile.TemporaryDirectory(prefix="kerv-slurm-") as name, pytest.MonkeyPatch.context() as patch:
        folder, host = Path(name), socket.gethostname().partition(".")[0]
        for part in ("state", "spool", "munge"):
            (folder / part).mkdir(mode=0o700)
        (folder / "munge/key").write_bytes(os.urandom(1024))
        (folder / "munge/key").chmod(0o600)
        with socket.socket() as one, socket.socket() as other:
            one.bind(("127.0.0.1", 0))
            other.bind(("127.0.0.1", 0))
            ports = one.getsockname()[1], other.getsockname()[1]
        user = subprocess.check_output(["id", "-un"], text=True).strip()
        text = CONFIGURATION.format(host=host, ports=ports, user=user, folder=folder)
        (folder / "slurm.conf").write_text(text)
        patch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        # without the folder of `kerv`: whoever types .venv/bin/kerv may not have it either
        patch.setenv("PATH", "/usr/sbin:/usr/local/bin:/usr/bin:/bin")
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        run("munged", "--force", *(f"--{option}={folder}/munge/{file}" for option, file in files.items()))
        try:
            run("slurmctld", "-f", str(folder / "slurm.conf"))
            run("slurmd", "-f", str(folder / "slurm.conf"))
            until(lambda: run("sinfo", "-h", "-o", "%T").strip() == "idle", 30)
            yield
            run("scancel", "--state=RUNNING", f"--user={user}")
            run("scancel", "--state=PENDING", f"--user={user}")
            until(lambda: not jobs(), 30)
        finally:
            for file in ("slurmd.pid", "slurmctld.pid", "munge/pid"):
                if (folder / file).exists():
                    os.kill(int((folder / file).read_text()), signal.SIGTERM)
            until(lambda: not list(folder.glob("*.pid")), 30)


def run(*words: str) -> str:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    return done.stdout if done.returncode == 0 else ""


def jobs() -> list[str]:
    """Return the jobs that wait or run, as 12_0."""
    return run("squeue", "--noheader", "--array", "--format=%i").split()


SWEEP = """
import sys
import studies_synthetic as s
import test_slurm as t
s.swept(sys.argv[1], t.STUDY, s.unhurried, runtime=t.SETTINGS)
"""
SETTINGS = compose("rollout", ["runtime=slurm"], RolloutSettings).runtime


@pytest.mark.usefixtures("slurm")
def test_a_study_survives_its_sweep_a_cancelled_worker_and_a_preempted_one(tmp_path):
    """The array of conf/runtime/slurm.yaml runs on when its sweep is killed; the next one starts another."""
    store, struck = Study(opened(tmp_path), "threshold"), []
    with python(SWEEP, tmp_path) as process:
        until(lambda: counts_of(store)[0] >= 2, 120)
        process.kill()

    def strike(event: object) -> None:
        if isinstance(event, Counted) and not struck and len(jobs()) >= 2:
            struck.extend(jobs())
            run("scancel", struck[0])
            run("scontrol", "requeue", struck[1])

    _, outcome = swept(tmp_path, STUDY, unhurried, runtime=SETTINGS, on_event=strike)
    assert (len(struck) >= 2, outcome.failed, counts_of(store)) == (True, [], (36, 36))
    with store.database.reading() as connection:
        assert connection.scalar(sa.select(sa.func.count()).select_from(EPISODES)) == 36
        assert connection.scalar(sa.select(sa.func.count()).select_from(WANTED).where(UNFINISHED)) == 0
