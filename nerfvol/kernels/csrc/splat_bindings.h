// Adds the operators on splats to the module.
#pragma once
#include <nanobind/nanobind.h>

void bind_splats(nanobind::module_& m);
