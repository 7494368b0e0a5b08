// NumPy arrays across the border between Python and the kernels. Only bindings include this.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <initializer_list>
#include <memory>
#include <utility>

namespace mapf {

template <class T, int dims>
using In = nanobind::ndarray<const T, nanobind::ndim<dims>, nanobind::c_contig, nanobind::device::cpu>;

template <class T, int dims>
using InOut = nanobind::ndarray<T, nanobind::ndim<dims>, nanobind::c_contig, nanobind::device::cpu>;

template <class T>
using Out = nanobind::ndarray<nanobind::numpy, T>;

// A new uninitialised NumPy array and the pointer to its memory, which Python owns.
template <class T>
std::pair<T*, Out<T>> make_array(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const auto extent : shape) size *= extent;
    auto memory = std::make_unique_for_overwrite<T[]>(size);
    T* data = memory.get();
    nanobind::capsule owner(data, [](void* p) noexcept { std::default_delete<T[]>{}(static_cast<T*>(p)); });
    memory.release();
    return {data, Out<T>(data, shape, owner)};
}

}  // namespace mapf
