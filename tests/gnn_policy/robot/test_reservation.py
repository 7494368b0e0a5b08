"""The local shield under any fate of its messages: the law is that no step collides."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import oracles
from gnn_policy.robot.reservation import Reservation

UP, LEFT, DOWN, RIGHT, IDLE = range(5)
SHIFT = {UP: (-1, 0), LEFT: (0, -1), DOWN: (1, 0), RIGHT: (0, 1), IDLE: (0, 0)}


def beyond(cell, move):
    return cell[0] + SHIFT[move][0], cell[1] + SHIFT[move][1]


@dataclass
class Team:
    """Robots of one step on a map, each with what its driver has accepted."""

    grid: np.ndarray
    cells: list
    scores: np.ndarray
    priorities: list
    turn: tuple = (0, 0)
    accepted: dict = field(default_factory=dict)

    def __post_init__(self):
        self.robots = [self.robot(number) for number in range(len(self.cells))]

    def robot(self, number):
        height, width = self.grid.shape

        def free(move):
            row, col = beyond(self.cells[number], move)
            return 0 <= row < height and 0 <= col < width and not self.grid[row, col]

        def far(other):
            return sum(abs(a - b) for a, b in zip(self.cells[number], self.cells[other], strict=True))

        near = {j: cell for j, cell in enumerate(self.cells) if j != number and far(j) <= 2}
        mask = np.array([free(move) for move in range(5)])
        arguments = (number, self.turn, self.cells[number], mask, self.scores[number], near, self.priorities[number])
        return Reservation(*arguments)

    def hear(self, receiver, sender, letter):
        if letter is not None:
            self.robots[receiver].hear(sender, letter)

    def resolve(self, number, last, answer: bool | None = True):
        def accept(move):
            if answer is not False:
                self.accepted[number] = move
            return answer

        self.robots[number].resolve(accept, last=last)

    def faults(self):
        after = [beyond(cell, self.accepted.get(number, IDLE)) for number, cell in enumerate(self.cells)]
        return oracles.faults(self.grid, self.cells, after)


@st.composite
def teams(draw):
    height, width = draw(st.integers(1, 4)), draw(st.integers(1, 4))
    count = draw(st.integers(1, min(height * width, 8)))
    order = draw(st.permutations(range(height * width)))
    cells = [divmod(place, width) for place in order[:count]]
    grid = np.zeros((height, width), bool)
    for place in order[count : count + draw(st.integers(0, 3))]:
        grid[divmod(place, width)] = True
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    priorities = random.integers(0, 4, count).tolist()
    turn = (draw(st.integers(0, 2**64 - 1)), draw(st.integers(0, 2**32 - 1)))
    return Team(grid, cells, random.random((count, 5), np.float32), priorities, turn)


@settings(max_examples=300)
@given(
    team=teams(),
    seed=st.integers(0, 2**32 - 1),
    rounds=st.integers(1, 6),
    loss=st.sampled_from([0.0, 0.1, 0.5, 0.9]),
    late=st.sampled_from([0.0, 0.3, 0.8]),
    twice=st.sampled_from([0.0, 0.3]),
    dies=st.sampled_from([0.0, 0.1]),
    unanswered=st.sampled_from([0.0, 0.5]),
)
def test_no_step_collides_whatever_becomes_of_the_messages(team, seed, rounds, loss, late, twice, dies, unanswered):
    """Robots act in any order within a round, messages are lost, come late or twice, robots die, answers are lost."""
    random = np.random.default_rng(seed)
    post, dead = [], set()
    for number in range(rounds):
        for i in random.permutation(len(team.cells)).tolist():
            if i in dead or random.random() < dies:
                dead.add(i)
                continue
            letter = team.robots[i].message()
            for j in range(len(team.cells)):
                if letter is not None and random.random() >= loss:
                    post += [(i, j, letter)] * (2 if random.random() < twice else 1)
            waiting, post = post, []
            for sender, receiver, body in (waiting[k] for k in random.permutation(len(waiting))):
                if random.random() < late:
                    post.append((sender, receiver, body))
                else:
                    team.robots[receiver].hear(sender, body)
            answer = (None if random.random() < 0.5 else False) if random.random() < unanswered else True
            team.resolve(i, last=number == rounds - 1 or bool(random.random() < 0.1), answer=answer)
    assert not team.faults()


@given(team=teams())
def test_a_robot_that_sees_nobody_gets_what_it_wants_most(team):
    for i, robot in enumerate(team.robots):
        others = [cell for j, cell in enumerate(team.cells) if j != i]
        if all(abs(team.cells[i][0] - row) + abs(team.cells[i][1] - col) > 2 for row, col in others):
            team.resolve(i, last=False)
            free = [
                move for move in range(5) if not oracles.faults(team.grid, [robot.cell], [beyond(robot.cell, move)])
            ]
            assert team.accepted[i] == max(free, key=lambda move: team.scores[i][move])


def lonely(cells, scores, turn=(0, 0), priorities=None):
    grid = np.zeros((3, 5), bool)
    return Team(grid, cells, np.array(scores, np.float32), priorities or [0] * len(cells), turn)


def want(*moves):
    return [[float(move == wanted) * 5 + float(move == IDLE) for move in range(5)] for wanted in moves]


def test_robots_that_hear_nothing_wait_for_those_that_precede_them_and_each_has_its_turn():
    """Two robots want the cell between them, and every message is lost: in each step exactly one goes."""
    went = []
    for step in range(60):
        team = lonely([(1, 1), (1, 3)], want(RIGHT, LEFT), turn=(9, step))
        for number in (0, 1):
            team.resolve(number, last=True)
        assert not team.faults()
        moved = [number for number in (0, 1) if team.accepted[number] != IDLE]
        assert len(moved) == 1
        went += moved
    assert 15 < sum(went) < 45


def test_a_robot_follows_another_only_once_its_driver_has_accepted():
    team = lonely([(1, 1), (1, 2)], want(RIGHT, RIGHT))
    team.hear(0, 1, team.robots[1].message())
    team.resolve(0, last=False)
    assert team.robots[0].committed is None
    team.resolve(1, last=False)
    team.hear(0, 1, team.robots[1].message())
    team.resolve(0, last=True)
    assert team.accepted == {0: RIGHT, 1: RIGHT}
    refused = lonely([(1, 1), (1, 2)], want(RIGHT, RIGHT))
    refused.resolve(1, last=False, answer=False)
    refused.hear(0, 1, refused.robots[1].message())
    refused.resolve(0, last=True)
    assert refused.accepted == {0: IDLE}


def test_a_robot_without_an_answer_of_its_driver_says_nothing_more():
    team = lonely([(1, 1), (1, 2)], want(RIGHT, RIGHT))
    team.resolve(1, last=False, answer=None)
    assert team.robots[1].message() is None
    team.resolve(0, last=True)
    assert team.accepted == {1: RIGHT, 0: IDLE}


def test_a_robot_on_its_goal_moves_aside_for_one_with_higher_priority():
    team = lonely([(1, 1), (1, 2)], want(RIGHT, IDLE), priorities=[5, 0])
    for number in range(4):
        letters = [robot.message() for robot in team.robots]
        for i in range(2):
            team.hear(i, 1 - i, letters[1 - i])
            team.resolve(i, last=number == 3)
    assert team.accepted[0] == RIGHT
    assert team.accepted[1] in (UP, DOWN, RIGHT)


def test_robots_whose_number_is_unknown_keep_the_cells_beside_them_closed():
    scores, free = np.array(want(RIGHT)[0], np.float32), np.ones(5, bool)
    moves = []
    for stranger in ((1, 3), (1, 2), (2, 2), (2, 1)):
        for step in range(30):
            robot = Reservation(0, (0, step), (1, 1), free, scores, {-1: stranger}, 0)
            robot.resolve(lambda move: True, last=True)
            moves.append((stranger, robot.committed))
    assert {move for stranger, move in moves if stranger != (2, 1)} == {IDLE}
    assert {move for stranger, move in moves if stranger == (2, 1)} == {RIGHT}


@pytest.mark.parametrize(
    "body",
    [
        b"",
        bytes(4),
        bytes(6),
        bytes([16, 0, 0, 0, 0]),
        bytes([1, 2, 0, 0, 0]),
        bytes([0, 0, 5, 0, 0]),
        bytes([3, 1, 0, 0, 0]),
    ],
)
def test_what_is_not_a_reservation_is_refused(body):
    team = lonely([(1, 1), (1, 2)], want(RIGHT, IDLE))
    with pytest.raises(ValueError, match="reservation"):
        team.robots[0].hear(1, body)
