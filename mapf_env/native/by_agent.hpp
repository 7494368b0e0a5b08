// Python's dictionaries by agent, as PettingZoo has them. Only bindings include this.
#pragma once

#include <nanobind/nanobind.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "mapf_env/native/checks.hpp"

namespace mapf {

// row[name] = value.
inline void set(PyObject* row, PyObject* name, PyObject* value) {
    if (value == nullptr || PyDict_SetItem(row, name, value) != 0) throw nanobind::python_error();
}

inline nanobind::object name(const char* text) { return nanobind::steal(PyUnicode_InternFromString(text)); }

// A new reference to sequence[i].
inline nanobind::object item(PyObject* sequence, Py_ssize_t i) {
    nanobind::object value = nanobind::steal(PySequence_GetItem(sequence, i));
    if (!value.is_valid()) throw nanobind::python_error();
    return value;
}

// {agent: {name: column[i], ...}, ...} for the i-th agent, or {agent: column[i], ...} without names.
inline nanobind::dict rows_by_agent(nanobind::list agents, nanobind::tuple names, nanobind::tuple columns) {
    const std::size_t width = names.size();
    if (columns.size() != std::max<std::size_t>(width, 1)) fail("give one column for each name");
    nanobind::dict rows;
    for (Py_ssize_t i = 0; i < PyList_Size(agents.ptr()); ++i) {
        PyObject* agent = PyList_GetItem(agents.ptr(), i);
        if (width == 0) {
            set(rows.ptr(), agent, item(PyTuple_GetItem(columns.ptr(), 0), i).ptr());
            continue;
        }
        const nanobind::dict row;
        for (std::size_t k = 0; k < width; ++k)
            set(row.ptr(), PyTuple_GetItem(names.ptr(), k), item(PyTuple_GetItem(columns.ptr(), k), i).ptr());
        set(rows.ptr(), agent, row.ptr());
    }
    return rows;
}

// Reads actions[agent] of each agent, in order. Returns false if the agents differ, or where an action is neither an int
// nor a NumPy integer: the caller in Python then reads it by the rule of all interfaces, or says what is wrong with it.
inline bool read_actions(const nanobind::dict& actions, const nanobind::list& agents,
                         std::vector<std::int64_t>& wanted) {
    const std::size_t count = wanted.size();
    if (actions.size() != count || agents.size() != count) return false;
    for (std::size_t i = 0; i < count; ++i) {
        PyObject* action = PyDict_GetItem(actions.ptr(), PyList_GetItem(agents.ptr(), static_cast<Py_ssize_t>(i)));
        if (action == nullptr) return false;
        if (PyBool_Check(action)) return false;
        const bool is_int = PyLong_Check(action);
        if (!is_int && std::strncmp(Py_TYPE(action)->tp_name, "numpy.", 6) != 0) return false;
        const nanobind::object whole = is_int ? nanobind::borrow(action) : nanobind::steal(PyNumber_Index(action));
        wanted[i] = whole.is_valid() ? PyLong_AsLongLong(whole.ptr()) : -1;
        if (wanted[i] == -1 && PyErr_Occurred()) {
            PyErr_Clear();
            return false;
        }
    }
    return true;
}

}  // namespace mapf
