"""Every regularizer, one file each, and their registry: what ``--regularizer`` and the launcher know by name."""

from ca_reg.chain import Chain
from ca_reg.registry import Registry
from ca_reg.regularizer import Regularizer
from ca_reg.regularizers.concrete import ConcreteDropout
from ca_reg.regularizers.drop_gaussian import DropGaussian
from ca_reg.regularizers.dropout import GaussianDropout
from ca_reg.regularizers.independent import IndependentDropout
from ca_reg.regularizers.noise import OpacityNoise
from ca_reg.regularizers.scale_noise import ScaleNoise
from ca_reg.regularizers.segs import SEGSNoise
from ca_reg.regularizers.sh_noise import SHNoise
from ca_reg.regularizers.soft import SoftDropout
from ca_reg.schedules import LinearRamp, StartStop

__all__ = ["REGULARIZERS", "GaussianDropout", "IndependentDropout", "OpacityNoise", "parse"]

REGULARIZERS: Registry[Regularizer] = Registry("regularizer", Regularizer, {"ramp": LinearRamp, "between": StartStop})
"""What can be asked for by name; ``REGULARIZERS.register("name")`` adds a class."""

REGULARIZERS.register("dropout")(GaussianDropout)
REGULARIZERS.register("noise")(OpacityNoise)
REGULARIZERS.register("scale_noise")(ScaleNoise)
REGULARIZERS.register("sh_noise")(SHNoise)
REGULARIZERS.register("concrete")(ConcreteDropout)
REGULARIZERS.register("drop_gaussian")(DropGaussian)
REGULARIZERS.register("soft")(SoftDropout)
REGULARIZERS.register("segs")(SEGSNoise)


def parse(text: str, *, imports: bool = True) -> Chain:
    """Make regularizers of an expression: names of the registry or ``module:Class``, joined by ``+``.

    Args:
        text: such as ``"dropout(0.2) + noise(0.8, scale=True)"``, ``"dropout(ramp(0, 0.2, 0, 10_000))"`` or
            ``"my_module:MyDropout(0.3)"``; an empty one makes an empty chain.
        imports: whether ``module:Class`` may be imported; False for text that somebody else wrote.

    Raises:
        ValueError: if it cannot be understood; says what.

    Example:
        >>> [type(member).__name__ for member in parse("dropout(0.2) + noise(0.8)")]
        ['GaussianDropout', 'OpacityNoise']
    """
    return Chain(*REGULARIZERS.make(text, imports=imports))
