"""Parts of a network that a user brings along."""

import torch


class Deaf(torch.nn.Module):
    """A graph layer which hears nobody."""

    def __init__(self, in_features, out_features, taps):
        super().__init__()
        self.mix = torch.nn.Linear(in_features, out_features)

    def forward(self, signal, graph):
        return self.mix(signal)


class Forgetful(Deaf):
    """One that drops half of what it has."""

    def forward(self, signal, graph):
        return torch.nn.functional.dropout(super().forward(signal, graph), training=self.training)
