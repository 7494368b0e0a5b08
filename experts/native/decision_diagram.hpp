// Multi-valued decision diagrams (MDDs): all paths of one robot of one length (Sharon, Stern, Goldenberg and Felner
// 2013, "The increasing cost tree search for optimal multi-agent pathfinding").
//
// Level t holds the cells where the robot can be at time t on such a path. On an empty map, from A one row down and one
// column right to D, the MDD of length 2 is
//
//     level 0      level 1      level 2
//                  B (right)
//     A       <                 D            two paths: A B D and A C D
//                  C (down)
//
// build() tries the shortest lengths one by one, then floods forward to the first length that is possible:
//     1. forward: level by level, the cells from which the goal is still in reach, unless a constraint forbids them
//     2. backward (prune): nodes without a successor are removed
// A level of width 1 is a cell that every shortest path visits: a conflict there is cardinal for the robot.
//
// Invariant: the paths from the first level to the last are exactly the paths of `length` steps that obey the
// constraints and arrive with the last step.
//
// JointSearch walks two MDDs in lockstep, depth first over pairs of nodes, and remembers the pairs that failed. Two
// robots whose MDDs have no compatible pair of paths are dependent (see proving_search.hpp).
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/pair_table.hpp"
#include "experts/native/traffic.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// The constraints on one robot.
struct Constraints {
    struct Ban {
        int cell, time;
        std::uint8_t actions;  // that must not lead the robot into the cell (a bit each)
    };
    struct ClosedCell {
        int cell, time;  // from this time on the robot must not be in the cell
    };
    int earliest = 0, latest = forever;  // time of arrival
    std::vector<Ban> bans;
    std::vector<ClosedCell> closed_cells;

    void clear() {
        earliest = 0;
        latest = forever;
        bans.clear();
        closed_cells.clear();
    }
};

// The paths of a robot that arrive at exactly `length`: a node is a cell at a time, `next` the node after each action.
struct DecisionDiagram {
    struct Node {
        int cell;
        std::array<int, num_actions> next;
    };
    static constexpr int none = -1;

    int length = -1;  // -1: no path obeys the constraints
    std::vector<Node> nodes;
    std::vector<int> level;  // the first node of each time 0..length, and the end

    std::span<const Node> at(int time) const {
        return std::span(nodes).subspan(static_cast<std::size_t>(level[time]),
                                        static_cast<std::size_t>(level[time + 1] - level[time]));
    }
};

// Builds diagrams of the shortest paths that obey constraints, and extracts paths from them.
class DiagramBuilder {
public:
    // The length of the diagram is -1 if no path obeys the constraints, and also if the budget is spent.
    void build(const Grid& grid, int start, int goal, const Distance* distance, const Constraints& constraints,
               DecisionDiagram& diagram, Budget& budget);

    // Writes a path of `diagram` with the fewest conflicts with `traffic`, and returns their number.
    int best_path(const DecisionDiagram& diagram, const Traffic& traffic, std::vector<std::uint8_t>& actions);

private:
    bool try_length(int start, int length, DecisionDiagram& diagram, Budget& budget);
    int first_arrival(int start, int goal, int earliest, int latest, int last_constraint, Budget& budget);
    void prune(DecisionDiagram& diagram);

    const Distance* distance_ = nullptr;
    std::array<int, num_actions> steps_{};
    PairTable<std::uint8_t> banned_;
    std::vector<int> closed_from_;     // forever, where a cell is not closed
    std::vector<int> index_of_;        // in the next level, for each cell
    std::vector<int> new_index_, frontier_, next_frontier_, reached_at_;
    struct Reached {
        int conflicts, parent;
        std::uint8_t action;
    };
    std::vector<Reached> reached_;
};

// Finds out if two diagrams have a compatible pair of paths. After many joint states it gives up and returns true,
// which only weakens the heuristic.
class JointSearch {
public:
    bool compatible(const DecisionDiagram& first, const DecisionDiagram& second);

private:
    bool search(int time, int i, int j);

    const DecisionDiagram* first_ = nullptr;   // the shorter one
    const DecisionDiagram* second_ = nullptr;
    PairTable<std::uint8_t> failed_;  // by the two nodes
};

}  // namespace mapf
