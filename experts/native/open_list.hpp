// The open nodes of the high level: a lower bound on the optimal cost, and FOCAL, the nodes within w times that bound.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

#include "experts/native/problem.hpp"

namespace mapf {

// Costs are integers and never below the root's, so nodes are counted and kept waiting by cost in plain arrays.
class OpenList {
public:
    void reset(double w, int root_cost) {
        w_ = w;
        root_cost_ = root_cost;
        lowest_ = 0;
        size_ = 0;
        std::fill(count_.begin(), count_.end(), 0);
        for (auto& nodes : waiting_) nodes.clear();
        focal_.clear();
        limit_ = focal_limit();
    }

    bool empty() const { return size_ == 0; }

    // The lowest cost of an open node.
    int lower_bound() const { return root_cost_ + lowest_; }

    // `cost` must not be below the lowest cost of an open node.
    void push(int id, int cost, int conflicts) {
        const auto level = static_cast<std::size_t>(cost - root_cost_);
        if (level >= count_.size()) {
            count_.resize(level + 1, 0);
            waiting_.resize(level + 1);
        }
        ++count_[level];
        ++size_;
        if (cost <= limit_)
            add_to_focal({conflicts, cost, id});
        else
            waiting_[level].push_back({conflicts, cost, id});
    }

    // Takes the node of FOCAL with the fewest conflicts; then the cheapest, then the newest.
    int pop() {
        raise_lower_bound();
        std::pop_heap(focal_.begin(), focal_.end(), is_worse);
        const auto best = focal_.back();
        focal_.pop_back();
        --count_[static_cast<std::size_t>(best.cost - root_cost_)];
        --size_;
        return best.id;
    }

    // To be called when the open nodes have changed and before the bound is read.
    void raise_lower_bound() {
        const int before = limit_;
        while (size_ > 0 && count_[static_cast<std::size_t>(lowest_)] == 0) ++lowest_;
        limit_ = focal_limit();
        const int last = std::min(limit_ - root_cost_, static_cast<int>(waiting_.size()) - 1);
        for (int level = std::max(0, before - root_cost_ + 1); level <= last; ++level) {
            for (const auto& entry : waiting_[level]) add_to_focal(entry);
            waiting_[level].clear();
        }
    }

private:
    struct Entry {
        int conflicts, cost, id;
    };

    static bool is_worse(const Entry& a, const Entry& b) {
        if (a.conflicts != b.conflicts) return a.conflicts > b.conflicts;
        if (a.cost != b.cost) return a.cost > b.cost;
        return a.id < b.id;
    }

    void add_to_focal(const Entry& entry) {
        focal_.push_back(entry);
        std::push_heap(focal_.begin(), focal_.end(), is_worse);
    }

    int focal_limit() const {
        return static_cast<int>(std::min<std::int64_t>(cost_limit(w_, lower_bound()), std::numeric_limits<int>::max()));
    }

    double w_ = 1;
    int root_cost_ = 0;
    int lowest_ = 0;  // above the root's cost
    int limit_ = 0;   // highest cost in FOCAL
    int size_ = 0;
    std::vector<int> count_;                   // open nodes by cost above the root's
    std::vector<std::vector<Entry>> waiting_;  // open nodes outside FOCAL, the same way
    std::vector<Entry> focal_;                 // a heap
};

}  // namespace mapf
