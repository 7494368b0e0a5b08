// NumPy arrays across the border between Python and the kernels. Only bindings include this.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <utility>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace mapf {

template <class T, int dims>
using In = nanobind::ndarray<const T, nanobind::ndim<dims>, nanobind::c_contig, nanobind::device::cpu>;

template <class T, int dims>
using InOut = nanobind::ndarray<T, nanobind::ndim<dims>, nanobind::c_contig, nanobind::device::cpu>;

template <class T>
using Out = nanobind::ndarray<nanobind::numpy, T>;

// Asks for large pages, with which much fresh memory is ready several times sooner. Nothing depends on the answer.
inline void prefer_large_pages(void* data, std::size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
    constexpr std::uintptr_t page = std::uintptr_t{1} << 21;
    const auto begin = reinterpret_cast<std::uintptr_t>(data);
    const std::uintptr_t first = (begin + page - 1) / page * page, last = (begin + bytes) / page * page;
    if (first < last) (void)madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#else
    (void)data, (void)bytes;
#endif
}

// A new uninitialised NumPy array and the pointer to its memory, which Python owns.
template <class T>
std::pair<T*, Out<T>> make_array(std::initializer_list<std::size_t> shape) {
    std::size_t size = 1;
    for (const auto extent : shape) size *= extent;
    auto memory = std::make_unique_for_overwrite<T[]>(size);
    T* data = memory.get();
    prefer_large_pages(data, size * sizeof(T));
    nanobind::capsule owner(data, [](void* p) noexcept { std::default_delete<T[]>{}(static_cast<T*>(p)); });
    memory.release();
    return {data, Out<T>(data, shape, owner)};
}

}  // namespace mapf
