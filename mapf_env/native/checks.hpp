// Error messages for wrong arguments from Python. Only bindings include this.
#pragma once

#include <nanobind/nanobind.h>

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <string>

#include "mapf_env/native/grid.hpp"

namespace mapf {

[[noreturn]] inline void fail(const std::string& message) { throw nanobind::value_error(message.c_str()); }

inline void require(bool holds, const char* message) {
    if (!holds) fail(message);
}

inline std::string shown(std::initializer_list<std::size_t> shape) {
    std::string text;
    for (const auto extent : shape) text += (text.empty() ? "(" : ", ") + std::to_string(extent);
    return text + ")";
}

// Actions (B, N) of all robots, those that are not there too.
inline void require_actions(const std::int64_t* actions, std::size_t num_envs, std::size_t num_agents) {
    const std::size_t robots = num_envs * num_agents;
    const auto is_none = [](std::int64_t action) { return static_cast<std::uint64_t>(action) >= num_actions; };
    bool any = false;
    for (std::size_t i = 0; i < robots; ++i) any |= is_none(actions[i]);
    if (!any) return;
    const std::size_t i = std::find_if(actions, actions + robots, is_none) - actions;
    fail("action " + std::to_string(actions[i]) + " of agent " + std::to_string(i % num_agents) + " in environment " +
         std::to_string(i / num_agents) + " is none of 0..4 (up, left, down, right, idle)");
}

}  // namespace mapf
