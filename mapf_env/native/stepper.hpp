// Python's view of the fused step. Only bindings include this.
#pragma once

#include <nanobind/nanobind.h>

namespace mapf {

void define_stepper(nanobind::module_& m);

}  // namespace mapf
