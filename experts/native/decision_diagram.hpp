// All paths of one length: a multi-valued decision diagram (Sharon, Stern, Goldenberg and Felner 2013).
//
// Invariant: every path through a diagram obeys the constraints and arrives at its length, and every such path is in it.
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <vector>

#include "experts/native/budget.hpp"
#include "experts/native/cell_time_table.hpp"
#include "experts/native/traffic.hpp"
#include "mapf_env/native/distances.hpp"
#include "mapf_env/native/grid.hpp"

namespace mapf {

// What one robot has to obey.
struct Constraints {
    struct Ban {
        int cell, time;
        std::uint8_t actions;  // by which the robot must not arrive (a bit each)
    };
    struct ClosedCell {
        int cell, time;  // from when on the robot must not be there
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

// Builds diagrams of the shortest paths that obey constraints, and reads paths out of them.
class DiagramBuilder {
public:
    // An unsolvable diagram also if the budget is spent.
    void build(const Grid& grid, int start, int goal, const Distance* distance, const Constraints& constraints,
               DecisionDiagram& diagram, Budget& budget);

    // Of the paths of `diagram` one with the fewest conflicts with `traffic`; returns their number.
    int best_path(const DecisionDiagram& diagram, const Traffic& traffic, std::vector<std::uint8_t>& actions);

private:
    bool try_length(int start, int length, DecisionDiagram& diagram, Budget& budget);
    int first_arrival(int start, int goal, int earliest, int latest, int last_constraint, Budget& budget);
    void prune(DecisionDiagram& diagram);

    const Distance* distance_ = nullptr;
    std::array<int, num_actions> steps_{};
    CellTimeTable<std::uint8_t> banned_;
    std::vector<int> closed_from_;     // forever, where a cell is not closed
    std::vector<int> index_of_;        // in the next level, for each cell
    std::vector<int> new_index_, here_, after_, since_;
    struct Arrival {
        int conflicts, parent;
        std::uint8_t action;
    };
    std::vector<Arrival> arrivals_;
};

// Whether two robots have paths in their diagrams that do not conflict. Gives up with "yes" after many joint states.
class JointSearch {
public:
    bool compatible(const DecisionDiagram& first, const DecisionDiagram& second);

private:
    bool search(int time, int i, int j);

    const DecisionDiagram* first_ = nullptr;   // the shorter one
    const DecisionDiagram* second_ = nullptr;
    CellTimeTable<std::uint8_t> dead_;  // by the two nodes
};

}  // namespace mapf
