"""How far each observation is to be believed, as a small network learned it (``scripts/train_weights.py``)."""

from collections.abc import Sequence
from importlib.resources import files

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from torchtrack.config.tracker import AssociationConfig
from torchtrack.errors import UnknownFormatError
from torchtrack.object_model.contour_source import ContourModel
from torchtrack.tracking.association.weighting_features import FEATURES, WeightingInputs, silhouette_features, trust_features

_SHIPPED = "learned.safetensors"


class TrustNetwork(nn.Module):
    """Believes an observation by the space-time patch of events around it (:mod:`torchtrack.tracking.association.weighting_features`).

    Args:
        hidden: widths of its two hidden layers.
    """

    def __init__(self, hidden: tuple[int, int] = (48, 24)) -> None:
        super().__init__()
        first, second = hidden
        self.layers = nn.Sequential(nn.Linear(FEATURES, first), nn.ReLU(), nn.Linear(first, second), nn.ReLU(), nn.Linear(second, 1))

    @classmethod
    def shipped(cls) -> "TrustNetwork":
        """The network with the weights that come with the package, which are not to be trained on unless they are told to."""
        return cls.from_bytes((files("torchtrack") / "weights" / _SHIPPED).read_bytes()).requires_grad_(False)

    @classmethod
    def from_bytes(cls, content: bytes) -> "TrustNetwork":
        """The network with weights from a safetensors file.

        Raises:
            UnknownFormatError: if these are no such weights.
        """
        network = cls()
        try:
            network.load_state_dict(load(content))
        except (SafetensorError, RuntimeError) as error:
            raise UnknownFormatError(f"not the weights of this network, as TrustNetwork.as_bytes gives them: {error}") from error
        return network

    def logits(self, features: Float[Tensor, "*b f"]) -> Float[Tensor, "*b"]:
        """The network itself: log odds that observations are of their contour."""
        return self.layers(features)[..., 0]

    def forward(self, inputs: WeightingInputs) -> Float[Tensor, "b n"]:
        """How far each observation is to be believed, 0 to 1."""
        return torch.sigmoid(self.logits(trust_features(inputs)))

    def as_bytes(self) -> bytes:
        """Its weights as a safetensors file."""
        return save({name: value.contiguous() for name, value in self.state_dict().items()})


class SilhouetteTrust(nn.Module):
    """A weighting network: believes observations of the smooth silhouettes as a network does, and all others in full.

    What fires beside a sharp edge is nearly always of that edge, and few of them hold a pose: whatever is believed less there
    is missed. Before a smooth silhouette lies the shading of the surface, which fires, too, and moves otherwise.
    """

    def __init__(self, network: TrustNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, inputs: WeightingInputs) -> Float[Tensor, "b n"]:
        """How far each observation is to be believed, 0 to 1."""
        features, is_smooth, objects = silhouette_features(inputs)
        trust = torch.sigmoid(self.network.logits(features))
        if len(objects) < len(is_smooth):
            trust = trust.new_ones(is_smooth.shape).index_copy(0, objects, trust)
        return torch.where(is_smooth, trust, 1.0)


def shipped_network(models: Sequence[ContourModel], config: AssociationConfig) -> nn.Module | None:
    """The weighting network that ``weighting_network`` asks for; none where it has nothing to say of these models."""
    if config.weighting_network == "all":
        return TrustNetwork.shipped()
    if config.weighting_network == "silhouettes" and any(bool(model.is_bent.any()) for model in models):
        return SilhouetteTrust(TrustNetwork.shipped())
    return None
