"""Print the table of docs/randomization.md: every quantity that a randomization may vary."""

import ast
import itertools
from pathlib import Path

from gridnav.envs import PARAMETERS, RANDOMIZATION_PRESETS, Randomization

SOURCE = Path(__file__).parents[1] / "envs" / "randomization.py"


def meanings() -> dict[str, str]:
    """First sentence of the string below each field of ``Randomization``."""
    classes = [node for node in ast.parse(SOURCE.read_text(encoding="utf-8")).body if isinstance(node, ast.ClassDef)]
    (body,) = (one.body for one in classes if one.name == Randomization.__name__)
    found = {}
    for field, text in itertools.pairwise(body):
        if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
            assert isinstance(field.target, ast.Name)
            found[field.target.id] = ast.unparse(text.value)[1:-1].replace("\\n    ", " ")
    return found


def main() -> None:
    """Print one row per quantity."""
    meaning, burger = meanings(), RANDOMIZATION_PRESETS["burger"]
    print("| quantity | unit | nominal | `burger` | possible | drawn | acts on | what it is |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, one in PARAMETERS.items():
        own = getattr(burger, name)
        drawn = (
            ""
            if name not in burger.names
            else f"{own.low:g}"
            if own.low == own.high
            else f"{own.low:g} to {own.high:g}"
        )
        log = ", log" if own.law == "log" else ""
        print(
            f"| `{name}` | {one.unit} | {one.nominal:g} | {drawn}{log} | {one.lowest:g} to {one.highest:g} "
            f"| {one.drawn} | {one.acts_on} | {meaning[name]} |"
        )


if __name__ == "__main__":
    main()
