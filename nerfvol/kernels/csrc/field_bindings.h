// Adds the operators on neural fields to the module.
#pragma once
#include <nanobind/nanobind.h>

void bind_fields(nanobind::module_& m);
