// What every kernel behind a plain C interface needs: threads for one call, exceptions as a status code, and its digest.
#pragma once
#include <exception>
#include <mutex>
#include <new>
#include <thread>
#include <vector>

// Runs f(worker) on `threads` threads, the calling one among them. They live for one call: no pool to survive a fork, no OpenMP
// runtime beside the one that torch brings.
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
  std::vector<std::thread> thread_team;
  thread_team.reserve(threads);
  for (int w = 1; w < threads; w++) {
    try {
      thread_team.emplace_back(run, w);
    } catch (const std::exception&) {
      run(w);  // the system has no more threads, or no memory for one: run it here
    }
  }
  run(0);
  for (auto& t : thread_team) t.join();
  if (error) std::rethrow_exception(error);
}

// A function of the interface returns one of these: exceptions must not cross it.
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

// Digest of the sources that this library was compiled from, so that a stale one is noticed.
extern "C" const char* genre_digest() { return SOURCE_DIGEST; }
