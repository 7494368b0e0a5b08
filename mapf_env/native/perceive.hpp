// Python's view of the senses. Only bindings include this.
#pragma once

#include <nanobind/nanobind.h>

#include "mapf_env/native/senses.hpp"

namespace mapf {

// Reads the fields of a `mapf_env.Senses` by name.
Senses senses_of(nanobind::handle config);

void define_perceive(nanobind::module_& m);

}  // namespace mapf
