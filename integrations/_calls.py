"""Calls of a rasterizer: their arguments, their results, and the function that makes them."""

from __future__ import annotations

import functools
import inspect
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from types import CodeType, FrameType
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from ca_reg import Chain, OpacityNoise, Params, Regularizer

from ._report import Skip, Tally

_OF_CALL = ("view_matrix", "step")  # fields that are not per Gaussian


def chain_of(regularizer: nn.Module) -> Chain:
    """Wrap a user's regularizer in a chain; TypeError if it is not a module, ValueError if it learns per Gaussian."""
    chain = Chain(regularizer)
    if chain.learns:
        raise ValueError(
            f"{_who(chain, 'learns', *chain.learns)} learns {', '.join(chain.learns)} for each Gaussian, which only "
            "the bundled trainer (ca-reg train) can keep with the Gaussians: train there, or leave it out."
        )
    return chain


class Signature:
    """Binds the arguments of calls of one function; if all have names, in a tenth of the time that inspect takes."""

    def __init__(self, full: inspect.Signature) -> None:
        self.full = full
        self._names = dict(full.parameters)
        named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        self._all_named = all(x.kind in named for x in self._names.values())

    def bind(self, args: Sequence[Any], kwargs: Mapping[str, Any]) -> tuple[dict[str, Any], int | None]:
        """Return the arguments by name, and how many were given by position, or None if no number describes that.

        Raises a TypeError for arguments that do not fit.
        """
        found = dict(zip(self._names, args, strict=False))
        found.update(kwargs)
        fits = len(found) == len(args) + len(kwargs) and found.keys() <= self._names.keys()
        if self._all_named and fits and "opacities" in found:
            return found, len(args)
        return self.full.bind(*args, **kwargs).arguments, None


class Call:
    """A call of a rasterizer whose bound ``arguments`` may be changed before it is made."""

    names: ClassVar[Mapping[str, str]] = {}  # of arguments, by field of Params, where the two differ
    instead: ClassVar[str] = ""  # which arguments replace these in some calls, for messages

    def __init__(self, function: Callable[..., Any], signature: Signature, args: Sequence[Any], kwargs: Any) -> None:
        self.function = function
        self._signature = signature
        self.arguments, self._positional = signature.bind(args, kwargs)

    def __call__(self) -> Any:
        """Rasterize."""
        if self._positional is None:
            bound = inspect.BoundArguments(self._signature.full, self.arguments)
            return self.function(*bound.args, **bound.kwargs)
        values, items = list(self.arguments.values()), list(self.arguments.items())
        first = self._positional  # bound in order: those given by position come first
        return self.function(*values[:first], **dict(items[first:]))

    def takes(self, name: str) -> bool:
        """Whether the function has an argument of this name, given or not."""
        return name in self._signature.full.parameters

    @classmethod
    def check(cls, chain: Chain, signature: inspect.Signature) -> None:
        """Raise a ValueError if a regularizer needs a field that no call with this signature can supply."""
        for name in chain.needs:
            if name not in Params._fields or cls.names.get(name, name) not in (*signature.parameters, *_OF_CALL):
                raise ValueError(
                    f"{_who(chain, 'needs', name)} needs {name}, which this rasterizer does not take; it takes "
                    f"{', '.join(signature.parameters)}."
                )

    def get(self, field: str) -> Tensor | None:
        """Return a field as the rasterizer takes it; None if this call does not have it."""
        value: Tensor | None = self.arguments.get(self.names.get(field, field))
        return value

    def put(self, field: str, value: Tensor) -> None:
        """Replace a field."""
        if field in _OF_CALL:
            raise ValueError(
                f"a regularizer changed {field}, which belongs to the call and is no field of the Gaussians."
            )
        name = self.names.get(field, field)
        given = self.arguments[name]
        self.arguments[name] = value if value.shape == given.shape else value.reshape_as(given)

    def params(self, regularizer: Regularizer, step: int, *, testing: bool = False) -> Params:
        """Return the opacities (N,) and the other needed fields, batches flattened; ValueError if one is missing."""
        opacities: Tensor = self.arguments["opacities"]
        if opacities.ndim != 1:
            opacities = opacities.reshape(-1)
        found: dict[str, Any] = {}
        for name in regularizer.needs:
            if name in ("opacities", "step"):
                continue
            value = self.get(name)
            if value is not None and name != "view_matrix":
                value = value.flatten(0, -3 if name == "sh" else -2)
            if value is None or (name != "view_matrix" and len(value) != len(opacities)):
                # A test render of, say, plain colors is no concern of a regularizer that leaves test renders alone.
                chain = Chain(regularizer)
                users = [x for x in chain if name in x.needs and type(x).expected is not Regularizer.expected]
                if testing and not users:
                    continue
                raise ValueError(
                    f"{_who(chain, 'needs', name)} needs {name}, which this call of the rasterizer does not have for "
                    f"every Gaussian: {self.instead}."
                )
            found[name] = value
        return Params(opacities, step=step, **found)

    def train(
        self, regularizer: Regularizer, step: int, tally: Tally, generator: torch.Generator | None
    ) -> Tensor | None:
        """Apply a draw to the arguments; return which Gaussians it kept, None if it dropped none."""
        given = self.params(regularizer, step)
        # A call of the module checks more, and takes longer: the first one is enough.
        regularize = regularizer.regularize if tally.regularized else regularizer
        if self._replace(given, regularize(given, generator=generator)):
            tally.count_regularized(step)
        else:
            tally.skipped[Skip.RATE_ZERO] += 1
        return regularizer.keep

    def evaluate(self, chain: Chain, step: int, tally: Tally) -> None:
        """Apply the test-time values to the arguments."""
        given = self.params(chain, step, testing=True)
        if self._replace(given, chain.expected(given)):
            tally.scaled += 1
        else:
            tally.skipped[Skip.NOTHING_TO_SCALE] += 1

    def _replace(self, before: Params, after: Params) -> bool:
        """Put the changed fields into the arguments; return whether there were any."""
        changed = False
        for name, a, b in zip(Params._fields, before, after, strict=True):
            if a is not b:
                self.put(name, getattr(after, name))
                changed = True
        return changed


def _who(chain: Chain, attribute: str, *names: str) -> str:
    """Return the type names of the members that need, or learn, one of these names."""
    return ", ".join(type(member).__name__ for member in chain if set(names) & set(getattr(member, attribute)))


MODULES = ("diff_gaussian_rasterization", "diff_gaussian_rasterization_abs")
RASTERIZERS = tuple(f"{module}:GaussianRasterizer" for module in MODULES)


class RasterizerCall(Call):
    """One call of ``GaussianRasterizer.forward``.

    Convention: its settings hold the view matrix transposed, for row vectors; ``viewmatrix.T`` is world to camera.
    """

    names: ClassVar = {"means": "means3D", "quaternions": "rotations", "sh": "shs"}
    instead = (
        "cov3D_precomp takes the place of scales and rotations (switch off compute_cov3D_python), colors_precomp that "
        "of shs (convert_SHs_python, override_color)"
    )

    @property
    def rasterizer(self) -> Any:
        """The rasterizer itself."""
        return next(iter(self.arguments.values()))

    def get(self, field: str) -> Tensor | None:
        """Return a field; "dc", where a rasterizer takes the first band separately, is prepended to ``sh``."""
        if field == "view_matrix":
            matrix = getattr(getattr(self.rasterizer, "raster_settings", None), "viewmatrix", None)
            return None if matrix is None else matrix.T
        value = super().get(field)
        first = self.arguments.get("dc") if field == "sh" else None
        return value if value is None or first is None else torch.cat([first, value], 1)

    def put(self, field: str, value: Tensor) -> None:
        """Replace a field."""
        if field == "sh" and self.arguments.get("dc") is not None:
            self.arguments["dc"], value = value[:, :1], value[:, 1:]
        super().put(field, value)


def find_installed(rasterizers: Iterable[str]) -> list[str]:
    """Return the modules of ``module:Class`` that can be found, without an import; ImportError if there is none."""
    modules = dict.fromkeys(rasterizer.partition(":")[0] for rasterizer in rasterizers)
    found = [name for name in modules if name in sys.modules or find_spec(name.partition(".")[0]) is not None]
    if not found:
        raise ImportError(
            f"none of the rasterizers {', '.join(rasterizers)} is installed. Install the one in the submodules of your "
            "code base (it needs CUDA), pass your own class as rasterizer=..., in the launcher --rasterizer "
            "module:Class, or run the code base without CUDA: python -m ca_reg.integrations.run --cpu train.py ..."
        )
    return found


def rasterizer_classes() -> list[type]:
    """Import the installed rasterizers and return their classes; raise ImportError if there are none."""
    name = RASTERIZERS[0].partition(":")[2]
    found = [getattr(import_module(module), name, None) for module in find_installed(RASTERIZERS)]
    return list(dict.fromkeys(cls for cls in found if isinstance(cls, type)))


def forward_signature(rasterizer: type) -> inspect.Signature:
    """Return the signature of a rasterizer's forward; raise TypeError if it lacks the family's arguments."""
    forward = getattr(rasterizer, "forward", None)
    signature = inspect.signature(forward) if callable(forward) else inspect.Signature()
    if missing := [name for name in ("means3D", "opacities") if name not in signature.parameters]:
        raise TypeError(
            f"{rasterizer.__qualname__}.forward{signature} has no argument {' or '.join(missing)}, so it is no "
            "GaussianRasterizer of the INRIA family; pass the class of your code base as rasterizer=..."
        )
    return signature


def hide_dropped(returned: Any, keep: Tensor) -> tuple[Any, ...]:
    """Zero the radii of dropped Gaussians, and all other integers that a rasterizer returned per Gaussian.

    Densification derives visibility from these. Besides the radii some rasterizers return flags (3dgs-mcmc) or counts
    (taming-3dgs); floating-point sums of a Gaussian of opacity 0 are 0 already. Zeroes integers and bools of shape
    (N,), (N, 1) or (N, 2) where ``keep``, (N,) bool, is False. Raises a TypeError for anything but a tuple, and a
    ValueError for one without such a member.
    """
    if not isinstance(returned, tuple):
        raise TypeError(f"the rasterizer returned {type(returned).__name__}, expected a tuple with colors and radii.")
    count = keep.shape[0]
    members = list(returned)
    hidden = False
    for i, x in enumerate(returned):
        if isinstance(x, Tensor) and not x.is_floating_point() and x.shape in ((count,), (count, 1), (count, 2)):
            members[i] = x * (keep if x.ndim == 1 else keep[:, None]).to(x.device)
            hidden = True
    if not hidden:
        found = ", ".join(f"{x.dtype} {tuple(x.shape)}" if isinstance(x, Tensor) else str(type(x)) for x in returned)
        raise ValueError(
            f"the rasterizer returned ({found}) for {count} Gaussians, expected an integer tensor of shape ({count},), "
            "the radii: without them dropped Gaussians cannot be hidden from densification."
        )
    # Keep named tuples.
    made: tuple[Any, ...] = returned._make(members) if hasattr(returned, "_make") else tuple(members)
    return made


def white_alpha(call: RasterizerCall) -> Tensor:
    """Measure the accumulated alpha (H, W) of a finished call: make it again with all colors 1 over black."""
    if not call.takes("colors_precomp"):
        raise ValueError(
            f"{type(call.rasterizer).__name__} takes no colors_precomp, by which its alpha could be measured in white: "
            "return it from render, named alpha."
        )
    settings = call.rasterizer.raster_settings
    opacities: Tensor = call.arguments["opacities"]
    # "dc" holds the first band where a rasterizer takes it separately.
    call.arguments.update({name: None for name in ("shs", "dc") if name in call.arguments})
    call.arguments["colors_precomp"] = opacities.new_ones(opacities.shape[0], 3)
    call.rasterizer.raster_settings = settings._replace(bg=torch.zeros_like(settings.bg))
    try:
        with torch.no_grad():
            returned = call()
    finally:
        call.rasterizer.raster_settings = settings
    size = (3, settings.image_height, settings.image_width)
    # Normals and coordinates (RaDe-GS) have the shape of the image, and channels that differ.
    pictures = [x for x in returned if isinstance(x, Tensor) and tuple(x.shape) == size]
    white = [x for x in pictures if torch.allclose(x, x[:1].expand_as(x), atol=1e-4)]
    if not white:
        raise ValueError(
            f"the rasterizer returned no image of shape {size} all white: return the alpha from render, named alpha."
        )
    return white[0].mean(0)


_OUTWARD = 8  # foreign frames to search for a render function


class CallSite(NamedTuple):
    """The function that asks for a render.

    The tensors tell neither a viewer's render from a training render nor which model they belong to. The local
    variables of the function do, in every code base of the family and in any import order; they are only read.
    """

    variables: Mapping[str, Any]
    place: tuple[tuple[CodeType, int], ...]
    """Code and instruction of each frame from it outward: the same for all renders of one call in a loop."""

    @classmethod
    def find(cls) -> CallSite:
        """Return the nearest caller named render..., else the nearest outside of this package and torch."""
        outside = (x for x in _outward(sys._getframe(1)) if _is_outside(x.f_globals.get("__name__", "")))
        nearest = list(itertools.islice(outside, _OUTWARD))
        if not nearest:  # in a thread of autograd
            return cls({}, ())
        found = next((x for x in nearest if x.f_code.co_name.startswith("render")), nearest[0])
        variables = found.f_locals
        site = cls(dict(variables), tuple((x.f_code, x.f_lasti) for x in _outward(found)))
        # Before Python 3.13 a function's frame keeps this snapshot, and with it all tensors that the function deletes
        # or replaces, until it returns. The variables themselves are elsewhere; those of a module are this dict.
        if isinstance(variables, dict) and found.f_code.co_flags & inspect.CO_OPTIMIZED:
            variables.clear()
        return site

    def find_instance(self, classes: tuple[type, ...]) -> Any:
        """Return the first variable that is an instance of one of the classes, else None."""
        return next((x for x in self.variables.values() if isinstance(x, classes)), None)

    def is_viewer(self, camera: str | None) -> bool:
        """Whether a viewer asked for the render; it does so with gradients enabled, before the training render.

        ``camera`` is the class name of the viewer's cameras, None if there is no viewer.
        """
        return camera is not None and camera in [type(x).__name__ for x in self.variables.values()]

    def refuse_a_second_regularizer(self, names: Mapping[str, str]) -> None:
        """Raise a RuntimeError if the calling render already does what is to be done; see `second_regularizers`."""
        for name, kind in names.items():
            value = self.variables.get(name)
            if isinstance(value, (int, float)) and value > 0:
                if name == "sigma_noise" and not self.variables.get("train", True):
                    continue
                raise RuntimeError(
                    f"{kind} would be applied twice: the calling render has {name}={value:g}; switch it off with "
                    f"--{name} 0."
                )


def second_regularizers(chain: Chain) -> dict[str, str]:
    """Return the variables with which the paper's code does what a chain does, each with the class for it here."""
    perturbs = any(isinstance(member, OpacityNoise) for member in chain)
    names = {"dropout_factor": "GaussianDropout"} if chain.drops else {}
    return names | ({"sigma_noise": "OpacityNoise"} if perturbs else {})


def _outward(frame: FrameType | None) -> Iterator[FrameType]:
    """Iterate over a frame and its callers; traceback.walk_stack takes longer, as it finds out their lines."""
    while frame is not None:
        yield frame
        frame = frame.f_back


@functools.lru_cache(maxsize=1024)
def _is_outside(module: str) -> bool:
    return module.rpartition(".")[0] != __package__ and module.partition(".")[0] != "torch"
