"""The success rates that the paper reports, to draw next to your own."""

TEAMS: tuple[int, ...] = (4, 6, 8, 10, 12, 14)
"""Sizes of the test teams."""
PAPER = {
    4: (0.9431, 0.8518, 0.7531, 0.5980, 0.4909, 0.3642),
    6: (0.9638, 0.9313, 0.8747, 0.7916, 0.7058, 0.6227),
    8: (0.9676, 0.9442, 0.9140, 0.8547, 0.7842, 0.7042),
    10: (0.9647, 0.9520, 0.9249, 0.8984, 0.8544, 0.8136),
    12: (0.9696, 0.9542, 0.9347, 0.9082, 0.8791, 0.8302),
}
"""Figure 3 of the paper: success rate, a row for each size of the training teams, a column for each of TEAMS."""
