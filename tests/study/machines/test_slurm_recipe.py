"""The SLURM script of docs/study.md, as it stands there: `scontrol` and `srun` are stand-ins, Ray is Ray.

The script ends with `ray stop`, which ends every Ray process that it sees. So it runs where it sees none but its own,
in namespaces of processes and networks.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from study_process import entries, write_spec

pytest.importorskip("ray", reason="comes with the extra [cluster]")
pytestmark = pytest.mark.slow

_PAGE = Path(__file__).parents[3] / "docs" / "study.md"
_ALONE = ["unshare", "--fork", "--kill-child", "--pid", "--mount-proc", "--net", "--"]
#: One machine, of the only address that there is.
_SCONTROL = """\
#!/bin/bash
[ "$*" = "show hostnames $SLURM_JOB_NODELIST" ] && echo 127.0.0.1
"""
#: Without its options, which are of the form --NAME or --NAME=VALUE.
_SRUN = """\
#!/bin/bash
while [[ $1 == -* ]]; do shift; done
exec "$@"
"""


def script() -> str:
    (found,) = re.findall(r"```bash\n(#!/bin/bash\n#SBATCH .*?)```", _PAGE.read_text(), re.DOTALL)
    return found


@pytest.fixture
def environment(tmp_path: Path) -> Iterator[dict[str, str]]:
    """Of a job: SLURM's variables and programs, and a home folder without a token of Ray."""
    for name, text in {"bin/scontrol": _SCONTROL, "bin/srun": _SRUN}.items():
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        path.chmod(0o755)
    (tmp_path / "home").mkdir()
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "SLURM_"))}
    # Not pytest's folder: the names of Ray's sockets may have 107 letters.
    with tempfile.TemporaryDirectory(prefix="ray", ignore_cleanup_errors=True) as folder:
        yield {
            **kept,
            "HOME": str(tmp_path / "home"),
            "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}",
            "RAY_TMPDIR": folder,
            "RAY_USAGE_STATS_ENABLED": "0",
            "SLURM_JOB_NODELIST": "machine",
            "SLURM_NNODES": "1",
            "SLURM_CPUS_PER_TASK": "4",
        }


def submit(folder: Path, environment: dict[str, str]) -> str:
    """What the job says, run to its end in `folder`."""
    job = ["sh", "-c", 'ip link set lo up && exec bash "$1"', "sh", str(folder / "job.sh")]
    ended = subprocess.run(
        [*_ALONE, *job],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
        timeout=600,
    )
    assert ended.returncode == 0, ended.stdout
    return ended.stdout


def test_the_script_makes_the_runs_and_goes_on(
    environment: dict[str, str], balls_directory: Path, tmp_path: Path
) -> None:
    able = subprocess.run([*_ALONE, "ip", "link", "set", "lo", "up"], capture_output=True, text=True, check=False)
    if able.returncode:
        pytest.skip(f"nothing can be hidden from `ray stop` here (that takes root and iproute2): {able.stderr.strip()}")
    folder, log = tmp_path / "work", tmp_path / "log"
    activate = folder / ".venv" / "bin" / "activate"
    activate.parent.mkdir(parents=True)
    activate.write_text(f'export PATH="{Path(sys.executable).parent}:$PATH"\n')
    (folder / "job.sh").write_text(script())
    spec = write_spec(tmp_path, balls_directory, seeds=[0, 1], base={"log": str(log)})
    Path(spec).rename(folder / "my_study.toml")

    said = submit(folder, environment)
    assert "Ray: 1 machine, 1 at once, each with 4 cores" in said
    found = entries(folder / "OUT")
    assert [entry["status"] for entry in found.values()] == ["ok", "ok"], said
    assert (folder / "OUT" / "table.md").is_file()
    assert (tmp_path / "home" / ".ray" / "auth_token").is_file()

    said = submit(folder, environment)
    assert len(log.read_text().splitlines()) == 2, said  # nothing was fitted anew
    assert "run 1 of" not in said
    assert entries(folder / "OUT") == found
