"""Put small faults at random places in the code, to see how many of them the tests notice.

``python -m tests.drawn_faults SEED COUNT`` prints the faults. With a third argument FILE, it tries them. Each
line of this file, ``NUMBER TESTS``, names a fault and the tests that are run after mypy.

Every line of code is equally likely to be drawn, and all possible changes of a line are equally likely. Three
kinds of change are not faults and are never drawn:

- a new value of a named constant or of a default;
- swapped arguments of a function such as ``min`` or ``max``;
- a change of the argument ``strict`` of ``zip``, which only adds a check.
"""

from __future__ import annotations

import ast
import copy
import random
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.faults import ROOT, Fault, try_all

PRODUCT = ("litho_data", "litho_models", "litho_design")
OTHER: dict[type, type] = {
    **{ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Div},
    **{ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq},
    **{ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is},
    **{ast.And: ast.Or, ast.Or: ast.And},
}
PAIRS = (
    "x y,nx ny,min max,cos sin,lower upper,low high,rows columns,any all,sum mean,argmin argmax,before after"
)
PAIRS += (
    ",floor ceil,minimum maximum,fft2 ifft2,first second,first last,width_um height_um,union intersection"
)
EITHER_WAY = {"min", "max", "minimum", "maximum", "hypot"}
NAMES = {one: other for pair in PAIRS.split(",") for one, other in (pair.split(), pair.split()[::-1])}


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield wrong versions of this expression that a programmer could have written by mistake."""
    new = copy.deepcopy(node)
    match new:
        case ast.BinOp() | ast.BoolOp() if type(new.op) in OTHER:
            new.op = OTHER[type(new.op)]()
            yield new
        case ast.Compare(ops=[op]) if type(op) in OTHER:
            new.ops = [OTHER[type(op)]()]
            yield new
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            yield new.operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield from (
                ast.Constant(other) for other in ({value + 1, 1 - value} if value < 2 else {value + 1})
            )
        case ast.Constant(value=float(value)):
            yield ast.Constant(2 * value)
        case ast.Name(id=name) if name in NAMES:
            yield ast.Name(NAMES[name])
        case ast.Attribute(attr=name) if name in NAMES:
            new.attr = NAMES[name]
            yield new
        case ast.Tuple(elts=[first, second, *_], ctx=ast.Load()) | ast.List(elts=[first, second, *_]):
            new.elts[:2] = [second, first]
            yield new
        case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name in EITHER_WAY:
            return
        case ast.Call(args=[first, second, *_]):
            new.args[:2] = [second, first]
            yield new
        case ast.IfExp():
            new.body, new.orelse = new.orelse, new.body
            yield new


def expressions(tree: ast.AST, *, within: bool = False) -> Iterator[ast.AST]:
    """Yield all expressions in function bodies, except those in type annotations and messages."""
    for child in ast.iter_child_nodes(tree):
        types = getattr(tree, "annotation", 0), getattr(tree, "returns", 0)
        if isinstance(child, ast.arguments | ast.JoinedStr | ast.Raise) or child in types:
            continue
        if isinstance(child, ast.keyword) and child.arg == "strict":
            continue
        if within:
            yield child
        yield from expressions(child, within=within or isinstance(tree, ast.FunctionDef))


def drawn(seed: int, count: int) -> list[Fault]:
    """Draw ``count`` faults. Each fault contains the whole text of its file. It does not name any tests
    yet.
    """
    places: dict[tuple[Path, int], list[tuple[ast.expr, ast.AST]]] = {}
    for file in sorted(file for package in PRODUCT for file in (ROOT / package).rglob("*.py")):
        for node in expressions(ast.parse(file.read_bytes())):
            if isinstance(node, ast.expr):
                for new in changes(node):
                    if ast.dump(new) != ast.dump(node):
                        places.setdefault((file, node.lineno), []).append((node, new))
    chance = random.Random(seed)
    faults = []
    for number, (file, line) in enumerate(chance.sample(sorted(places), count), 1):
        node, new = chance.choice(places[file, line])
        source = file.read_bytes()
        starts = [0, *(at + 1 for at, byte in enumerate(source) if byte == ord("\n"))]
        assert node.end_lineno
        assert node.end_col_offset
        begin, end = starts[line - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        wrong = source[:begin] + f"({ast.unparse(new)})".encode() + source[end:]
        name = f"{number} {file.relative_to(ROOT)}:{line}  {ast.unparse(node)}  ->  {ast.unparse(new)}"
        faults.append(Fault(name, str(file.relative_to(ROOT)), source.decode(), wrong.decode(), ""))
    return faults


def main(seed: str, count: str, file: str = "") -> int:
    """Print the faults, or try those listed in ``file`` and return how many of them were not noticed."""
    faults = drawn(int(seed), int(count))
    if not file:
        print(*(one.name for one in faults), sep="\n")
        return 0
    lines = [line.split(maxsplit=1) for line in Path(file).read_text(encoding="utf-8").splitlines()]
    return try_all([faults[int(number) - 1]._replace(tests=tests) for number, tests in lines], typed=True)


if __name__ == "__main__":
    raise SystemExit(1 if main(*sys.argv[1:]) else 0)
