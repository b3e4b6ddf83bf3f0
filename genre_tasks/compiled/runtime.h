// What every kernel behind a plain C interface needs: threads for one call, exceptions as a status, and its digest.
#pragma once
#include <exception>
#include <mutex>
#include <new>
#include <system_error>
#include <thread>
#include <vector>

// Threads live for one call: no pool to survive a fork, no OpenMP runtime beside the one that torch brings.
template <class F>
static void parallel(int threads, F f) {
  std::mutex guard;
  std::exception_ptr error;
  auto run = [&](int worker) {
    try {
      f(worker);
    } catch (...) {
      std::lock_guard<std::mutex> lock(guard);
      error = std::current_exception();
    }
  };
  std::vector<std::thread> crew;
  crew.reserve(threads);
  for (int w = 1; w < threads; w++) {
    try {
      crew.emplace_back(run, w);
    } catch (const std::system_error&) {
      run(w);  // no more threads to be had: do it here
    }
  }
  run(0);
  for (auto& t : crew) t.join();
  if (error) std::rethrow_exception(error);
}

enum Status { OK = 0, OUT_OF_MEMORY = 1, FAILED = 2 };

template <class F>
static int guarded(F f) {
  try {
    f();
    return OK;
  } catch (const std::bad_alloc&) {
    return OUT_OF_MEMORY;
  } catch (...) {
    return FAILED;
  }
}

// Of what this library was built, so that a stale one is noticed.
extern "C" const char* genre_digest() { return SOURCE_DIGEST; }
