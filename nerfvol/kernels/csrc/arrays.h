// What all files of Python bindings share: numpy's arrays as arguments, and the check of their sizes.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>

#include <optional>
#include <stdexcept>

namespace nerfvol {

template <class T, class... Shape>
using In = nanobind::ndarray<const T, nanobind::numpy, nanobind::c_contig, nanobind::device::cpu, Shape...>;
template <class T, class... Shape>
using Out = nanobind::ndarray<T, nanobind::numpy, nanobind::c_contig, nanobind::device::cpu, Shape...>;

// nullptr where Python gave None.
template <class A> auto pointer(const std::optional<A>& array) -> decltype(array->data()) { return array ? array->data() : nullptr; }

// A ValueError of Python's with this message.
inline void require(bool fits, const char* message) {
    if (!fits) throw std::invalid_argument(message);
}

}  // namespace nerfvol
