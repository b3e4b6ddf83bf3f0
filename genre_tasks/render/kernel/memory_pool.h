// The part of the work that is a thread's, memory that grows, and pools in which used memory waits.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <mutex>
#include <new>
#include <stdexcept>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

// Where worker's part of n items begins, and the one before it ends.
static size_t work_begin(size_t n, int worker, int threads) { return n * worker / threads; }

constexpr size_t HUGE_PAGE = 2u << 20;

// Memory that is read and written all over: small pages miss the TLB, and each costs a fault when it is new.
static void prefer_huge_pages(void* p, size_t bytes) {
#if defined(MADV_HUGEPAGE)
  const size_t begin = ((size_t)p + HUGE_PAGE - 1) / HUGE_PAGE * HUGE_PAGE, end = ((size_t)p + bytes) / HUGE_PAGE * HUGE_PAGE;
  if (begin < end) madvise(reinterpret_cast<void*>(begin), end - begin, MADV_HUGEPAGE);
#endif
}

// Grows, never shrinks, is never initialised.
template <class T>
struct Buffer {
  T* p = nullptr;
  size_t n = 0, capacity = 0;
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  ~Buffer() { std::free(p); }
  void reserve(size_t m, size_t keep_first = 0) {
    if (m <= capacity) return;
    size_t page = (m + m / 4) * sizeof(T) < HUGE_PAGE ? 64 : HUGE_PAGE;
    size_t bytes = ((m + m / 4 + 64) * sizeof(T) + page - 1) / page * page;
    T* fresh = static_cast<T*>(std::aligned_alloc(page, bytes));
    if (!fresh) throw std::bad_alloc();
    prefer_huge_pages(fresh, bytes);
    if (keep_first) std::memcpy(static_cast<void*>(fresh), p, keep_first * sizeof(T));
    std::free(p);
    p = fresh, capacity = bytes / sizeof(T);
  }
  void resize(size_t m) { reserve(m), n = m; }
  T& operator[](size_t i) { return p[i]; }
  const T& operator[](size_t i) const { return p[i]; }
  size_t bytes() const { return capacity * sizeof(T); }
};

// Used memory is handed on to later calls, up to LIMIT of each kind: fresh pages cost more than the work on a small view.
template <class T>
struct MemoryPool {
  static constexpr size_t LIMIT = 512u << 20;
  std::mutex guard;
  std::vector<std::unique_ptr<T>> free;
  size_t pooled_bytes = 0;
  std::unique_ptr<T> take() {
    std::lock_guard<std::mutex> lock(guard);
    if (free.empty()) return std::make_unique<T>();
    auto x = std::move(free.back());
    free.pop_back(), pooled_bytes -= x->bytes();
    return x;
  }
  // Called by destructors and by functions without a status, so that it must not throw.
  void give(std::unique_ptr<T> x) noexcept {
    std::lock_guard<std::mutex> lock(guard);
    const size_t bytes = x->bytes();
    if (pooled_bytes + bytes > LIMIT) return;
    try {
      free.push_back(std::move(x));
      pooled_bytes += bytes;
    } catch (const std::bad_alloc&) {  // then its memory is freed
    }
  }
  void clear() {
    std::lock_guard<std::mutex> lock(guard);
    free.clear(), pooled_bytes = 0;
  }
};
