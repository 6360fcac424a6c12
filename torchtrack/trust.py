"""How far each observation is to be believed, as a small network learned it (``scripts/train_weights.py``): preset ``learned``."""

from importlib.resources import files

import torch
from jaxtyping import Float
from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor, nn

from torchtrack.errors import UnknownFormatError
from torchtrack.evidence import Evidence
from torchtrack.trust_features import FEATURES, trust_features

_SHIPPED = "learned.safetensors"


class TrustNetwork(nn.Module):
    """A weigher: believes an observation by the space-time patch of events around it (:mod:`torchtrack.trust_features`).

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

    def forward(self, evidence: Evidence) -> Float[Tensor, "b n"]:
        """How far each observation is to be believed, 0 to 1."""
        return torch.sigmoid(self.logits(trust_features(evidence)))

    def as_bytes(self) -> bytes:
        """Its weights as a safetensors file."""
        return save({name: value.contiguous() for name, value in self.state_dict().items()})
