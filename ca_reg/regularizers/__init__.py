"""All regularizers, one per module, and the registry that ``--regularizer`` and the launcher look names up in."""

from ca_reg.chain import Chain
from ca_reg.registry import Registry
from ca_reg.regularizer import Regularizer
from ca_reg.regularizers.clustered import ClusteredDropout
from ca_reg.regularizers.concrete import ConcreteDropout
from ca_reg.regularizers.d2gs import D2GSDropout
from ca_reg.regularizers.density import DensityDropout
from ca_reg.regularizers.depth import DepthDropout
from ca_reg.regularizers.drop_anchors import AnchorDropout
from ca_reg.regularizers.drop_gaussian import DropGaussian
from ca_reg.regularizers.drop_sh import SHDropout
from ca_reg.regularizers.dropout import GaussianDropout
from ca_reg.regularizers.geometry import GeometryDropout
from ca_reg.regularizers.independent import IndependentDropout
from ca_reg.regularizers.noise import OpacityNoise
from ca_reg.regularizers.position_noise import PositionNoise
from ca_reg.regularizers.scale_noise import ScaleNoise
from ca_reg.regularizers.segs import SEGSNoise
from ca_reg.regularizers.sh_noise import SHNoise
from ca_reg.regularizers.soft import SoftDropout
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

    Args:
        text: such as ``"dropout(0.2) + noise(0.8, scale=True)"``, ``"dropout(ramp(0, 0.2, 0, 10_000))"`` or
            ``"my_module:MyDropout(0.3)"``; an empty text makes an empty chain.
        imports: whether ``module:Class`` may be imported; False for text from an untrusted source.

    Raises:
        ValueError: as :meth:`Registry.make <ca_reg.registry.Registry.make>`.

    Example:
        >>> [type(member).__name__ for member in parse("dropout(0.2) + noise(0.8)")]
        ['GaussianDropout', 'OpacityNoise']
    """
    return Chain(*REGULARIZERS.make(text, imports=imports))
