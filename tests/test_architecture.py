"""The house's own rules, read from its imports."""

import ast
from pathlib import Path

ROOT = Path(__file__).parent.parent
# The floors of search/, the lowest first: a package imports from itself and from floors below.
FLOORS = [{"evolution", "training"}, {"execution"}, {"studies", "results"}, {"cli"}]


def imports(path: Path) -> list[str]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    return names + [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]


def floor(package: str) -> int:
    return next(number for number, packages in enumerate(FLOORS) if package in packages)


def test_imports_go_downwards() -> None:
    wrong = []
    for path in ROOT.glob("search/*/*.py"):
        own = path.parent.name
        for name in imports(path):
            other = name.split(".")[2] if name.startswith("sb3_aarl.search.") else own
            if floor(other) > floor(own) or (floor(own) == 0 and other != own):
                wrong.append(f"{path.relative_to(ROOT)} imports {name}")
    wrong += [
        f"{path.name} imports {name}"
        for path in ROOT.glob("sb3_aarl/*.py")
        for name in imports(path)
        if name.startswith("sb3_aarl.search")
    ]
    assert not wrong


def test_results_read_and_never_start_runs() -> None:
    for path in ROOT.glob("search/results/*.py"):
        assert not {"sb3_aarl.search.execution.driver", "sb3_aarl.search.execution.ray"} & set(imports(path)), path.name
    for path in ROOT.glob("search/*/*.py"):
        if path.parent.name != "execution":
            assert not {"subprocess", "multiprocessing"} & set(imports(path)) or path.name == "provenance.py", path.name
