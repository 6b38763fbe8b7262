"""What can be changed in a module so that a test should notice: small mistakes, one at a time."""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import CodeType

_COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Div,
    ast.Mod: ast.FloorDiv,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
}
_CALLED = {"min": "max", "max": "min", "any": "all", "all": "any", "minimum": "maximum", "maximum": "minimum"}
_WORDS = {"_log", "logging", "log", "warnings", "TypeVar", "cast"}
"""What says something and does nothing, or is of types only."""
_UNTOUCHED = {"__repr__", "__str__", "help"}


@dataclass(frozen=True)
class Mutant:
    """One change: where it is, what it was and what it becomes."""

    path: Path
    function: str
    """Qualified name of the outermost function that it is in."""
    first_line: int
    lines: tuple[int, int]
    """Of the statement that it is in: the first, and the one of what is changed."""
    site: int
    """Number of the changed node in ``ast.walk``, and of the change among those that it has."""
    choice: int
    what: str
    """In words; with a number behind from the second of the same words in one function on."""

    @property
    def name(self) -> str:
        """What it is called in lists."""
        return f"{self.path.as_posix()}::{self.function}: {self.what}"

    def code(self, file: Path) -> CodeType:
        """Return the changed module's code of the outermost function; ValueError where there is none."""
        tree = ast.parse(file.read_bytes())
        target = list(ast.walk(tree))[self.site]
        changed = ast.fix_missing_locations(_Put(target, _changes(target)[self.choice]).visit(tree))
        for code in _codes(compile(changed, str(file), "exec", dont_inherit=True)):
            if code.co_qualname == self.function and code.co_firstlineno == self.first_line:
                return code
        raise ValueError(self.name)


def mutants_of(path: Path, root: Path) -> list[Mutant]:
    """Return every mutant of a module, in the order of its text."""
    tree = ast.parse((root / path).read_bytes())
    numbers = {id(node): number for number, node in enumerate(ast.walk(tree))}
    times: Counter[str] = Counter()
    found = []
    for mutant in _walk(tree, _Place(path, numbers)):
        times[mutant.name] += 1
        time = times[mutant.name]
        found.append(mutant if time == 1 else replace(mutant, what=f"{mutant.what} (time {time})"))
    return found


@dataclass(frozen=True)
class _Place:
    path: Path
    numbers: dict[int, int]
    classes: tuple[str, ...] = ()
    function: ast.FunctionDef | ast.AsyncFunctionDef | None = None
    statement: int = 0


def _walk(node: ast.AST, at: _Place, parent: ast.AST | None = None) -> Iterator[Mutant]:
    if _is_skipped(node):
        return
    if isinstance(node, ast.ClassDef):
        at = _Place(at.path, at.numbers, (*at.classes, node.name)) if at.function is None else at
    elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        if at.function is None:
            at = _Place(at.path, at.numbers, at.classes, node)
        for statement in node.body:
            yield from _walk(statement, at, node)
        return
    if isinstance(node, ast.stmt):
        at = _Place(at.path, at.numbers, at.classes, at.function, node.lineno)
    if at.function is not None and hasattr(node, "lineno"):
        for choice, change in enumerate(_changes(node)):
            decorated = at.function.decorator_list
            yield Mutant(
                path=at.path,
                function=".".join((*at.classes, at.function.name)),
                first_line=decorated[0].lineno if decorated else at.function.lineno,
                lines=(at.statement, node.lineno),
                site=at.numbers[id(node)],
                choice=choice,
                what=_in_words(node, change, parent),
            )
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "args") and not isinstance(node, ast.Call):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _walk(child, at, node)


def _is_skipped(node: ast.AST) -> bool:
    """Whether nothing within is changed: words, types, compiled kernels, what is not there at run time."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        made = ast.unparse(ast.Tuple(node.decorator_list, ast.Load()))
        return node.name in _UNTOUCHED or any(word in made for word in ("njit", "compiled", "abstract"))
    if isinstance(node, ast.If):
        return "TYPE_CHECKING" in ast.unparse(node.test)
    if isinstance(node, ast.Call) and _caller(node.func) in _WORDS:
        return True
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        return _caller(node.value.func) in _WORDS
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Name):
        return node.exc.id == "NotImplementedError"
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        return _caller(node.exc.func) == "AssertionError"
    return isinstance(node, ast.JoinedStr | ast.Assert)


def _caller(function: ast.expr) -> str:
    while isinstance(function, ast.Attribute):
        function = function.value
    return function.id if isinstance(function, ast.Name) else ""


def _changes(node: ast.AST) -> list[ast.AST]:
    """Return what may stand in a node's place."""
    match node:
        case ast.Compare(ops=[operator]):
            made = [copy.copy(node) for _ in _COMPARED[type(operator)]]
            for changed, other in zip(made, _COMPARED[type(operator)], strict=True):
                changed.ops = [other()]
            return list(made)
        case ast.BinOp(op=operator) | ast.AugAssign(op=operator) if type(operator) in _COMPUTED:
            other = copy.copy(node)
            other.op = _COMPUTED[type(operator)]()
            return [other]
        case ast.BoolOp():
            return [ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)]
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            return [node.operand]
        case ast.Constant(value=bool()):
            return [ast.Constant(not node.value)]
        case ast.Constant(value=int()):
            return [ast.Constant(int(node.value) + 1)]
        case ast.Constant(value=float()):
            return [ast.Constant(2.0 * float(node.value) or 1.0)]
        case ast.If() | ast.While() | ast.IfExp() if not isinstance(node.test, ast.Compare | ast.UnaryOp):
            negated = copy.copy(node)
            negated.test = ast.UnaryOp(ast.Not(), node.test)
            return [negated]
        case ast.Expr(value=ast.Call()) | ast.Raise() | ast.Delete():
            return [ast.Pass()]
        case ast.Continue():
            return [ast.Break()]
        case ast.Break():
            return [ast.Continue()]
        case ast.Name(id=name) if name in _CALLED:
            return [ast.Name(_CALLED[name], node.ctx)]
        case ast.Attribute(attr=name) if name in _CALLED and isinstance(node.value, ast.Name):
            return [ast.Attribute(node.value, _CALLED[name], node.ctx)]
    return []


def _in_words(node: ast.AST, change: ast.AST, parent: ast.AST | None) -> str:
    """Return ``was -> becomes`` with a little of what is around."""
    before, after = node, change
    keyword = f"{parent.arg}=" if isinstance(parent, ast.keyword) else ""
    if isinstance(node, ast.If | ast.While):
        return f"if {ast.unparse(node.test)} -> if not ..."
    if isinstance(node, ast.Constant | ast.Name) and isinstance(parent, ast.expr | ast.Return | ast.Assign):
        before, after = parent, _Put(node, change).visit(_shallow(parent))
    was, becomes = (" ".join(ast.unparse(ast.fix_missing_locations(n)).split()) for n in (before, after))
    return f"{keyword}{was} -> {keyword}{becomes}"


def _shallow(node: ast.AST) -> ast.AST:
    """Return a copy whose lists are its own: what is put into it stays out of the tree."""
    made = copy.copy(node)
    for name, value in ast.iter_fields(node):
        if isinstance(value, list):
            setattr(made, name, list(value))
    return made


class _Put(ast.NodeTransformer):
    """Puts one node in another's place; goes no deeper than one below in a shallow copy."""

    def __init__(self, target: ast.AST, new: ast.AST) -> None:
        self._target, self._new = target, new

    def visit(self, node: ast.AST) -> ast.AST:
        return self._new if node is self._target else self.generic_visit(node)


def _codes(code: CodeType) -> Iterator[CodeType]:
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield constant
            yield from _codes(constant)
