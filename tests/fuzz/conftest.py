"""What the tests with damaged files share: the cases of benchmarks/fuzz_cases.py, and honest files to damage."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import HealthCheck, settings

from splashbench.prepare.media.reading import end_children

CASES = Path(__file__).parents[2] / "benchmarks" / "fuzz_cases.py"

settings.register_profile(
    "files", deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


@pytest.fixture(scope="session")
def cases() -> Iterator[ModuleType]:
    sys.path.insert(0, str(CASES.parent))  # where the modules are that it imports
    spec = importlib.util.spec_from_file_location("fuzz_cases", CASES)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.path.remove(str(CASES.parent))
    yield module
    end_children()


@pytest.fixture(scope="session")
def outcome(cases: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, int], str]:
    """(kind, number) -> what is wrong with how that case is read; empty where nothing is."""
    corpus = cases.Corpus(tmp_path_factory.mktemp("corpus"))
    return lambda kind, number: cases.outcome(kind, number, corpus)
