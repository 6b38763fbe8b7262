"""What can be registered under a name: solvers, priors, camera models, also of a user's own files."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from recon.errors import InputError, NoSuchNameError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class Named(Protocol):
    """What can be registered: it has a name, and a sentence for those who choose."""

    @property
    def name(self) -> str:
        """How it is called, in options and records."""
        ...

    @property
    def help(self) -> str:
        """One line."""
        ...


T = TypeVar("T", bound=Named)


class Registry(Mapping[str, T], Generic[T]):
    """Objects by name: first those of the project, then those of installed packages, then of this program.

    A package offers objects as entry points of a group, ``name = "module:object"``; they are loaded when
    somebody first asks what there is. One that cannot be loaded is not listed, and :meth:`named` says why.

    Parameters
    ----------
    what : str
        What these are, in the singular, for messages: "solver".
    group : str
        Of the entry points: "diffuserbench.solvers".
    own : callable
        Returns what the project itself has, when somebody first asks.
    """

    def __init__(self, what: str, group: str, own: Callable[[], Iterable[T]]) -> None:
        self.what, self.group = what, group
        self._make_own = own
        self._own: dict[str, T] | None = None
        self._foreign: dict[str, T] = {}
        self._broken: dict[str, str] = {}
        self._loading = threading.RLock()  # a plug-in may register itself while it is loaded
        self._loaded = False

    def __repr__(self) -> str:
        """Say which there are."""
        return f"<{self.what}s: {', '.join(self) or 'none beside those built in'}>"

    def register(self, registered: T) -> T:
        """Offer an object under its name, for the rest of the program.

        Raises InputError when the project itself has one of that name, or it has no name and help.
        """
        if not all(isinstance(getattr(registered, word, None), str) for word in ("name", "help")):
            raise InputError(
                f"A {self.what} is registered as an object with a name and a help in one line; "
                f"{registered!r} has not both."
            )
        if registered.name in self._known_own():
            raise InputError(f"There is a {self.what} {registered.name!r} already: take another name.")
        self._foreign[registered.name] = registered
        return registered

    def is_own(self, name: str) -> bool:
        """Whether the project itself offers what has this name."""
        return name in self._known_own()

    def named(self, name: str) -> T:
        """Return what has a name.

        Raises InputError when nothing has, with the names that there are.
        """
        if name in self:
            return self[name]
        import difflib

        known = self._all()
        if name in self._broken:
            raise InputError(f"The {self.what} {name!r} {self._broken[name]}")
        near = difflib.get_close_matches(str(name).lower(), known, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise InputError(f"The {self.what} {name!r} is not known. Choose one of {', '.join(known)}.{hint}")

    def names(self) -> tuple[str, ...]:
        """Return all names."""
        return tuple(self._all())

    def __getitem__(self, name: str) -> T:
        """Return what has a name; NoSuchNameError, a KeyError, where nothing has."""
        if name in self:
            own = self._known_own()
            return own[name] if name in own else self._foreign[name]
        raise NoSuchNameError(
            f"There is no {self.what} {name!r}, but {', '.join(self._all())}. .register(...) offers another."
        )

    def __contains__(self, name: object) -> bool:
        """Whether something has this name."""
        return isinstance(name, str) and (name in self._known_own() or name in self._foreign)

    def __iter__(self) -> Iterator[str]:
        """Iterate over names."""
        return iter(self._all())

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._all())

    def _all(self) -> dict[str, T]:
        own = self._known_own()
        return {**own, **self._foreign} if self._foreign else own

    def _known_own(self) -> dict[str, T]:
        if self._loaded and self._own is not None:
            return self._own
        with self._loading:
            if self._own is None:
                from importlib.metadata import entry_points  # a tenth of a second: not for an import of recon

                self._own = {registered.name: registered for registered in self._make_own()}
                for point in entry_points(group=self.group):
                    self._load(point)
                self._loaded = True
            return self._own

    def _load(self, point: EntryPoint) -> None:
        package = f"of the installed package {point.dist.name!r}" if point.dist else f"({point.value})"
        try:
            offered: T = point.load()
            name = offered.name
        except Exception as error:  # noqa: BLE001 - a plug-in may fail in any way, and that must not end the rest
            self._broken[point.name] = f"{package} cannot be loaded: {type(error).__name__}: {error}"
            return
        if self._own is not None and name in self._own:
            self._broken[point.name] = f"{package} has a name that the project uses itself: give it another."
        else:
            self._foreign[name] = offered
