"""Parts of a network that a user brings along."""

import torch


class Deaf(torch.nn.Module):
    """A graph layer that hears nobody."""

    def __init__(self, in_features, out_features, taps, edge_features):
        super().__init__()
        self.mix = torch.nn.Linear(in_features, out_features)

    def forward(self, features, bag):
        return self.mix(features)


class Forgetful(Deaf):
    """A graph layer that drops half of what it has."""

    def forward(self, features, bag):
        return torch.nn.functional.dropout(super().forward(features, bag), training=self.training)


class Sums(torch.nn.Module):
    """A graph layer in which a robot adds up the features of its neighbours."""

    def __init__(self, in_features, out_features, taps, edge_features):
        super().__init__()
        self.mix, self.taps = torch.nn.Linear(in_features, out_features), taps

    def forward(self, features, bag):
        sender, receiver = bag.edge_index
        for _ in range(self.taps - 1):
            features = features.index_add(0, receiver, features[sender])
        return self.mix(features)


class Flat(torch.nn.Sequential):
    """An encoder without convolutions."""

    def __init__(self, channels, side, features):
        super().__init__(torch.nn.Flatten(), torch.nn.Linear(channels * side * side, features))
