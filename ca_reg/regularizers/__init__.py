"""The regularizers by name, as ``--regularizer`` and the launcher look them up."""

from ca_reg.chain import Chain
from ca_reg.registry import Registry
from ca_reg.regularizer import Regularizer
from ca_reg.regularizers.clustered import AnchorDropout, ClusteredDropout, SHDropout
from ca_reg.regularizers.concrete import ConcreteDropout, SoftDropout
from ca_reg.regularizers.depth import D2GSDropout, DepthDropout
from ca_reg.regularizers.dropout import DropGaussian, GaussianDropout, IndependentDropout
from ca_reg.regularizers.noise import OpacityNoise, PositionNoise, ScaleNoise, SHNoise
from ca_reg.regularizers.segs import SEGSNoise
from ca_reg.regularizers.surroundings import DensityDropout, GeometryDropout
from ca_reg.schedules import SCHEDULES

__all__ = ["REGULARIZERS", "GaussianDropout", "IndependentDropout", "OpacityNoise", "parse"]

REGULARIZERS: Registry[Regularizer] = Registry(
    "regularizer",
    Regularizer,
    SCHEDULES,
    dropout=GaussianDropout,
    noise=OpacityNoise,
    clustered=ClusteredDropout,
    concrete=ConcreteDropout,
    d2gs=D2GSDropout,
    density=DensityDropout,
    depth=DepthDropout,
    drop_anchors=AnchorDropout,
    drop_gaussian=DropGaussian,
    drop_sh=SHDropout,
    geometry=GeometryDropout,
    position_noise=PositionNoise,
    scale_noise=ScaleNoise,
    segs=SEGSNoise,
    sh_noise=SHNoise,
    soft=SoftDropout,
)
"""The regularizers by name; the decorator ``REGULARIZERS.register("name")`` adds a class."""


def parse(text: str, *, imports: bool = True) -> Chain:
    """Parse an expression into regularizers: registered names or ``module:Class``, joined by ``+``.

    An empty text makes an empty chain. With ``imports=False``, for text from an untrusted source, ``module:Class``
    raises a ValueError, as everything does that :meth:`Registry.make <ca_reg.registry.Registry.make>` cannot parse.

    Example:
        >>> [type(member).__name__ for member in parse("dropout(0.2) + noise(0.8)")]
        ['GaussianDropout', 'OpacityNoise']
    """
    return Chain(*REGULARIZERS.make(text, imports=imports))
