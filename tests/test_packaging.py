"""What a stranger gets: the wheel's contents, and the set-up scripts run against stand-ins for Python, apt and sudo."""

import email
import os
import re
import shutil
import subprocess
import sys
import zipfile
from configparser import ConfigParser
from pathlib import Path

import pytest
from loaded import module_of
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from kerv_cli.targets import provenance
from kerv_cli.targets.compact.program import kernels

ROOT = Path(__file__).resolve().parents[1]
STAMP = Path(".venv/.kerv-installed")
EDITABLE = "pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .[dev]"
TOOLS = ("awk", "bash", "cat", "chmod", "dirname", "env", "grep", "make", "mkdir", "rm", "sleep", "touch")

# --- the wheel ---


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    built = subprocess.run([*command, "--wheel-dir", folder, ROOT], capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    (path,) = folder.glob("kerv-*.whl")
    return zipfile.ZipFile(path)


@pytest.fixture(scope="module")
def metadata(wheel):
    (name,) = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
    return email.message_from_bytes(wheel.read(name))


def test_the_wheel_carries_the_package_and_every_config_file(wheel):
    names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    configs = {f"kerv_cli/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert names >= configs | {path.relative_to(ROOT).as_posix() for path in (ROOT / "kerv_cli").rglob("*.py")}
    assert {name.split("/")[0] for name in names} == {"kerv_cli"}
    assert {"kerv_cli/__init__.pyi", "kerv_cli/py.typed"} <= names, "types of the library"


def test_the_command_names_a_function_that_the_wheel_holds(wheel):
    (name,) = [name for name in wheel.namelist() if name.endswith("entry_points.txt")]
    entry_points = ConfigParser()
    entry_points.read_string(wheel.read(name).decode())
    module, function = entry_points["console_scripts"]["kerv"].split(":")
    assert f"def {function}(" in wheel.read(module.replace(".", "/") + ".py").decode()


def test_the_requirements_keep_the_physics_engine_that_results_depend_on(metadata):
    requirements = metadata.get_all("Requires-Dist") or []
    assert "mujoco==3.3.0" in requirements
    assert any(line.startswith("rerun-sdk") and "extra" not in line for line in requirements), (
        "recording needs no extra"
    )
    assert any(line.startswith("metaworld") and ">=3.1.1" in line for line in requirements)


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    """Variables of a process that imports the wheel. Its kernels are compiled: they are those of the checkout."""
    folder = tmp_path_factory.mktemp("installed")
    wheel.extractall(folder / "site")
    ours, theirs = Path(str(kernels().__file__)), folder / "site/kerv_cli/targets/compact/kernels.py"
    shutil.copytree(ours.parent / "__pycache__", theirs.parent / "__pycache__")
    shutil.copystat(ours, theirs)  # numba compares the times
    others = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    return others | {"PYTHONPATH": str(folder / "site"), "TMPDIR": str(folder)}


KERNELS = """
import numba

@numba.njit("float64(float64)", cache=True)
def run(number):
    return number
"""


def test_processes_compile_once_and_say_so(installed, tmp_path):
    """Of two at once one compiles and the other waits. A third, which is given a cache folder that cannot be written,
    finds what they kept beside the code."""
    site = tmp_path / "site"
    shutil.copytree(installed["PYTHONPATH"], site, ignore=shutil.ignore_patterns("pretrained", "__pycache__"))
    (site / "kerv_cli/targets/compact/kernels.py").write_text(KERNELS)  # few, to compile fast
    own = installed | {"PYTHONPATH": str(site), "TMPDIR": str(tmp_path)}
    script = "from kerv_cli.targets.compact.program import kernels; kernels()"
    told = []
    for changes in ([{}, {}], [{"NUMBA_CACHE_DIR": "/proc/none"}]):
        processes = [
            subprocess.Popen([sys.executable, "-c", script], cwd=tmp_path, env=own | one, stderr=subprocess.PIPE)
            for one in changes
        ]
        told += [process.communicate()[1].decode() for process in processes]
        assert not any(process.returncode for process in processes), told
    assert sorted("compiling for this CPU" in text for text in told[:2]) == [False, True]
    assert "compiling" not in told[2]


def test_an_installed_wheel_runs_its_main_job_from_another_folder(wheel, installed, tmp_path):
    sizes = [entry.file_size for entry in wheel.infolist() if entry.filename.startswith("kerv_cli/pretrained/")]
    assert 10e6 < sum(sizes) < 20e6, "docs/install.md and pyproject.toml state its size"
    command = ["rollout", "method=one_pass", "task=drawer-open", "episodes=1", "world.horizon=8", "record=0"]
    command = [sys.executable, "-W", "ignore", "-m", "kerv_cli", *command]
    assert "one_pass, observation vision" in subprocess.check_output(command, cwd=tmp_path, env=installed, text=True)
    assert (tmp_path / "results/kerv.db").is_file()
    command = [sys.executable, "-m", "kerv_cli", "estimate", "weights=7B", "tokens=7"]
    assert "what pays first is" in subprocess.check_output(command, cwd=tmp_path, env=installed, text=True)


# --- make setup ---


def executable(path: Path, script: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/usr/bin/env bash\n{script}")
    path.chmod(0o755)


# A Python of version $KERV_TEST_VERSION. The one in its environments logs what pip is asked, fails on request,
# and says that MuJoCo can draw once the file `drawable` exists.
PYTHON = r"""
case "$1 $2" in
    "-c import sys; sys.exit"*)
        "$KERV_TEST_PYTHON" -c "import sys; sys.version_info = (${KERV_TEST_VERSION:-3, 11}, 0); $2" ;;
    "-c import ensurepip"*) true ;;
    "-m venv") mkdir -p .venv/bin && cat "$0" > .venv/bin/python && chmod +x .venv/bin/python ;;
    "-m pip") [ "$3" = --version ] && exit 0
              [ "$3" = freeze ] && { cat frozen 2>/dev/null || true; exit 0; }
              echo "pip ${@:3}" >> log
              [[ "$*" = *torch==* && -e no-torch ]] && exit 1; [ ! -e pip-fails ] ;;
    "-I -S") [ -e drawable ] ;;
    *) echo "unexpected: $*" >&2; exit 97 ;;
esac
"""


class Checkout:
    """A copy of the Makefile and its scripts where only stand-ins can be found on the PATH."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.bin = root / "stand-ins"
        shutil.copytree(ROOT / "scripts", root / "scripts", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree(ROOT / "requirements", root / "requirements")
        shutil.copy(ROOT / "Makefile", root)
        (root / "pyproject.toml").touch()
        self.bin.mkdir()
        for tool in TOOLS:
            found = shutil.which(tool)
            assert found, f"{tool} is needed here"
            (self.bin / tool).symlink_to(found)
        executable(self.bin / "python3", PYTHON)
        executable(self.bin / "apt-get", 'echo "apt-get $*" >> log; [ "$1" = update ] || touch drawable')
        executable(self.bin / "apt-cache", "true")
        self.user(0)
        (root / "drawable").touch()

    def user(self, uid: int) -> None:
        executable(self.bin / "id", f"echo {uid}")

    def setup(self, **extra: str) -> subprocess.CompletedProcess[str]:
        own = {"PATH": str(self.bin), "HOME": str(self.root), "KERV_TEST_PYTHON": sys.executable}
        environment = {**own, "KERV_NVIDIA": str(self.root / "driver"), **extra}
        return subprocess.run(
            ["make", "setup"], cwd=self.root, env=environment, capture_output=True, text=True, check=False
        )

    @property
    def log(self) -> list[str]:
        path = self.root / "log"
        return path.read_text().splitlines() if path.exists() else []


@pytest.fixture
def checkout(tmp_path):
    return Checkout(tmp_path)


@pytest.fixture
def undrawable(checkout):
    """A checkout on a machine without graphics libraries."""
    (checkout.root / "drawable").unlink()
    return checkout


def setup_lines(result: subprocess.CompletedProcess[str]) -> list[str]:
    """The lines that the scripts wrote on standard error; make adds its own."""
    return [line for line in result.stderr.splitlines() if not line.startswith("make")]


def test_setup_installs_once(checkout):
    first = checkout.setup()
    assert first.returncode == 0
    assert ".venv/bin/kerv doctor" in first.stdout.splitlines()[-1]
    pip = "pip install --quiet --disable-pip-version-check"
    index = "https://download.pytorch.org/whl/cpu"
    assert checkout.log == [
        f"{pip} --no-deps --retries 1 --extra-index-url {index} {locked('cpu', 'torch')}",
        f"{pip} --no-deps --require-hashes --requirement requirements/common.txt",
        EDITABLE,
    ]
    second = checkout.setup()
    assert (second.returncode, second.stdout, second.stderr) == (0, "", "")
    assert len(checkout.log) == 3
    (checkout.root / STAMP).unlink()
    (checkout.root / "frozen").write_text(f"numpy==1\n{locked('cpu', 'torch')}\n")
    checkout.setup()
    assert len(checkout.log) == 5, "PyTorch that is there is not fetched again"


def locked(build: str, package: str) -> str:
    """The line of a package in a lock file."""
    lines = (ROOT / "requirements" / f"{build}.txt").read_text().splitlines()
    return next(line for line in lines if line.startswith(f"{package}=="))


def test_another_pytorch_is_taken_where_the_locked_build_is_not_to_be_had(checkout):
    (checkout.root / "no-torch").touch()
    result = checkout.setup()
    assert result.returncode == 0
    (line,) = setup_lines(result)
    assert line.startswith(f"setup: {locked('cpu', 'torch')} is not to be had here: taking the PyTorch that")
    assert checkout.log[-2].endswith("--requirement requirements/common.txt --requirement requirements/cuda.txt")
    assert checkout.log[-1] == EDITABLE


def test_an_nvidia_driver_or_a_request_chooses_the_build_and_setup_says_what_it_fetches(checkout):
    asked = checkout.setup(CUDA="1")
    assert "CUDA build of PyTorch" in asked.stdout
    assert "CUDA=0" in asked.stdout
    assert checkout.log[-2].endswith("--requirement requirements/common.txt --requirement requirements/cuda.txt")
    assert checkout.setup(CUDA="1").stdout == ""
    back = checkout.setup()  # the other build is another installation
    assert "CPU build of PyTorch" in back.stdout
    (checkout.root / "driver").touch()
    (checkout.root / STAMP).unlink()
    assert "CUDA build of PyTorch" in checkout.setup().stdout
    (checkout.root / STAMP).unlink()
    assert "CPU build of PyTorch" in checkout.setup(CUDA="0").stdout


def test_the_lock_files_hold_a_hash_of_every_requirement(metadata):
    pinned: dict[str, str] = {}
    for file in ("common", "cuda"):
        for block in re.split(r"\n(?! )", (ROOT / f"requirements/{file}.txt").read_text().strip()):
            if block.startswith("#"):
                continue
            line, *hashes = block.split(" \\\n")
            assert hashes, line
            assert all(re.fullmatch(r"  --hash=sha256:[0-9a-f]{64}", one) for one in hashes)
            requirement = Requirement(line)
            pinned[canonicalize_name(requirement.name)] = str(requirement.specifier).removeprefix("==")
    assert locked("cpu", "torch") == f"torch=={pinned['torch']}+cpu"
    extras = {"lerobot", "openvla", "postgres", "serve", "dev", ""}
    for requirement in map(Requirement, metadata.get_all("Requires-Dist") or []):
        if requirement.name != "kerv" and any(
            requirement.marker is None or requirement.marker.evaluate({"extra": extra}) for extra in extras
        ):
            assert requirement.specifier.contains(pinned[canonicalize_name(requirement.name)]), requirement


def test_a_failed_installation_is_tried_again(checkout):
    (checkout.root / "pip-fails").touch()
    assert checkout.setup().returncode != 0
    assert not (checkout.root / STAMP).exists()
    (checkout.root / "pip-fails").unlink()
    assert checkout.setup().returncode == 0
    assert (checkout.root / STAMP).exists()


@pytest.mark.parametrize(("version", "lines"), [("3, 10", 1), ("3, 13", 0), ("3, 14", 1)])
def test_setup_takes_the_pythons_that_kerv_runs_on_and_refuses_others_in_one_line(checkout, version, lines):
    result = checkout.setup(KERV_TEST_VERSION=version)
    assert (result.returncode != 0) == lines
    assert ["Python 3.11, 3.12 or 3.13" in line for line in setup_lines(result)] == [True] * lines
    assert (checkout.root / ".venv").exists() == (not lines)


def test_root_gets_the_graphics_libraries_from_fresh_lists(undrawable):
    assert undrawable.setup().returncode == 0
    update, install = (line for line in undrawable.log if line.startswith("apt-get"))
    assert update.startswith("apt-get update")
    assert {"libegl1", "libgl1", "libgl1-mesa-dri", "libosmesa6"} <= set(install.split())
    (undrawable.root / "drawable").unlink()
    (undrawable.root / STAMP).unlink()
    executable(undrawable.bin / "apt-cache", '[ "$2" != libosmesa6 ]')  # the system no longer has it
    assert undrawable.setup().returncode == 0
    assert "libegl1" in undrawable.log[-1].split()
    assert "libosmesa6" not in undrawable.log[-1].split()


def test_sudo_is_used_where_it_asks_nothing(undrawable):
    undrawable.user(1000)
    executable(undrawable.bin / "sudo", 'echo "sudo $*" >> log; shift; "$@"')
    assert undrawable.setup().returncode == 0
    assert any(line.startswith("sudo -n apt-get install") for line in undrawable.log)


@pytest.mark.parametrize("sudo", [None, "exit 1"])
def test_without_the_right_to_install_setup_prints_the_command(undrawable, sudo):
    undrawable.user(1000)
    if sudo:
        executable(undrawable.bin / "sudo", sudo)
    result = undrawable.setup()
    assert result.returncode != 0
    (line,) = setup_lines(result)
    assert "sudo apt-get update && sudo apt-get install -y libegl1 libgl1 libgl1-mesa-dri libosmesa6" in line
    assert not any(line.startswith("apt-get") for line in undrawable.log)
    assert (undrawable.root / STAMP).exists(), "the Python part is done and need not be done again"


# --- the check for graphics ---


def test_a_library_that_is_absent_or_not_opengl_does_not_count_as_graphics():
    check = module_of(ROOT / "scripts" / "check_gl.py")
    assert not check.egl_works(("libkerv-absent.so.1",))
    assert not check.osmesa_works(("libkerv-absent.so.1",))
    assert check.load(("libkerv-absent.so.1", "libc.so.6"), "printf") is not None
    assert not check.egl_works(("libc.so.6",))
    assert not check.osmesa_works(("libc.so.6",))


@pytest.mark.skipif(sys.platform != "linux", reason="other systems bring their own OpenGL")
def test_the_graphics_check_agrees_that_this_machine_can_draw():
    command = [sys.executable, "-I", "-S", ROOT / "scripts" / "check_gl.py"]
    check = subprocess.run(command, capture_output=True, text=True, check=False)
    assert check.returncode == 0
    assert check.stdout.strip() in {"egl", "osmesa"}


def test_a_change_anywhere_in_the_checkout_marks_the_commit(tmp_path):
    package, config = tmp_path / "kerv/package", tmp_path / "kerv/conf/method.yaml"
    for path in (package / "__init__.py", config):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("r: 1\n")
    git = ["git", "-C", str(tmp_path / "kerv"), "-c", "user.name=a", "-c", "user.email=a@b"]
    assert provenance.git_commit(package) == "none"
    provenance.git_commit.cache_clear()
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run([*git, *words], check=True)
    commit = provenance.git_commit(package)
    assert len(commit) == 40
    provenance.git_commit.cache_clear()
    config.write_text("r: 2\n")
    assert provenance.git_commit(package) == f"{commit}+changes"
    provenance.git_commit.cache_clear()
