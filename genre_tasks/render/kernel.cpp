// The CPU rasteriser behind a plain C interface. Every result has the same bits at any number of threads.
#include <algorithm>
#include <atomic>
#include <cstdint>
#include <cstdlib>
#include <exception>
#include <map>
#include <memory>
#include <mutex>
#include <new>
#include <stdexcept>
#include <thread>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "kernel_blend.h"

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

static size_t share(size_t n, int worker, int threads) { return n * worker / threads; }

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

// What the backward pass needs of one view.
struct View {
  Camera camera;
  int tiles_x, tiles_y;
  struct Segment {
    size_t begin, end;
  };
  size_t drawn;
  std::vector<Segment> segments;         // places in input order that are taken: each thread leaves a gap behind its own
  Buffer<Footprint> input;               // drawn footprints, by place
  Buffer<uint32_t> id, slot_end, tile_begin;  // by place: Gaussian, end of its pair slots; by tile: first pair
  Buffer<Pair> pairs;                    // tile after tile, each front to back
  Buffer<uint16_t> visited;              // by pair: blocks that the forward pass visited
  Buffer<uint8_t> reached;               // by slot: whether it visited any
  Buffer<int> taken;                     // by tile: pairs until all rays had ended
  long long culled[CULL_REASONS];
  size_t bytes() const {
    return input.bytes() + id.bytes() + slot_end.bytes() + tile_begin.bytes() + pairs.bytes() +
           visited.bytes() + reached.bytes() + taken.bytes();
  }
};

// The gradients of one view's Gaussians that some ray reached: what is hidden has none.
struct GradientList {
  std::vector<uint32_t> id;
  Buffer<Lanes> gradient;  // [id / LANES, ATTRIBUTES], a Gaussian a lane
  size_t bytes() const { return gradient.bytes() + id.capacity() * sizeof(uint32_t); }
};

// What a pass needs only while it runs.
struct Scratch {
  Buffer<uint64_t> keys, other;
  std::vector<std::unique_ptr<Buffer<uint32_t>>> tiles;  // per thread: tile numbers of its footprints
  std::vector<std::vector<uint32_t>> histogram;          // per thread, per tile
  Buffer<uint32_t> order;
  Buffer<Lanes> slots;
  std::vector<std::unique_ptr<GradientList>> gradients;  // per thread
  size_t bytes() const {
    size_t sum = keys.bytes() + other.bytes() + order.bytes() + slots.bytes();
    for (auto& t : tiles) sum += t->bytes();
    for (auto& g : gradients) sum += g->bytes();
    return sum;
  }
};

// Used memory is handed on, up to LIMIT of each kind: fresh pages cost more than the work on a small view.
template <class T>
struct Shelf {
  static constexpr size_t LIMIT = 512u << 20;
  std::mutex guard;
  std::vector<std::unique_ptr<T>> free;
  size_t held = 0;
  std::unique_ptr<T> take() {
    std::lock_guard<std::mutex> lock(guard);
    if (free.empty()) return std::make_unique<T>();
    auto x = std::move(free.back());
    free.pop_back(), held -= x->bytes();
    return x;
  }
  void give(std::unique_ptr<T> x) {
    std::lock_guard<std::mutex> lock(guard);
    if (held + x->bytes() <= LIMIT) held += x->bytes(), free.push_back(std::move(x));
  }
};
// Never destroyed: a handle may be freed while the process ends.
static Shelf<View>& views_shelf() { static auto* s = new Shelf<View>; return *s; }
static Shelf<Scratch>& scratch_shelf() { static auto* s = new Shelf<Scratch>; return *s; }
static Shelf<GradientList>& gradients_shelf() { static auto* s = new Shelf<GradientList>; return *s; }

static int clamp_tile(float pixel, int low, int high) {
  return (int)std::min((float)high, std::max((float)low, std::floor((pixel - 0.5f) * (1.f / TILE))));
}

// Tiles under a footprint: for each row of tiles the exact extent of the ellipse within that band.
template <class F>
static inline void for_tiles(const Footprint& g, int tiles_x, int tiles_y, F f) {
  int last_row = clamp_tile(g.y + g.half_y, -1, tiles_y - 1);
  for (int j = clamp_tile(g.y - g.half_y, 0, tiles_y); j <= last_row; j++) {
    float from = std::max(j * TILE + 0.5f - g.y, -g.half_y), to = std::min(j * TILE + TILE - 0.5f - g.y, g.half_y);
    float right = std::min(std::max(g.dy_at_right, from), to), left = std::min(std::max(-g.dy_at_right, from), to);
    float sr = std::sqrt(std::max(0.f, (g.level - g.m * right * right) * g.inv_a));
    float sl = std::sqrt(std::max(0.f, (g.level - g.m * left * left) * g.inv_a));
    int first = clamp_tile(g.x - g.k * left - sl, 0, tiles_x);
    int last = clamp_tile(g.x - g.k * right + sr, -1, tiles_x - 1);
    for (int i = first; i <= last; i++) f(j * tiles_x + i);
  }
}

static void project_all(View& v, const GaussianArrays& in, int threads) {
  v.input.resize(in.count), v.id.resize(in.count), v.slot_end.resize(in.count);
  std::fill(v.slot_end.p, v.slot_end.p + in.count, 0);
  v.segments.resize(threads);
  std::vector<long long> culled((size_t)threads * CULL_REASONS, 0);
  parallel(threads, [&](int w) {
    size_t first = share(in.count, w, threads), at = first, end = share(in.count, w + 1, threads);
    long long tally[CULL_REASONS] = {};
    for (size_t i = first; i < end; i += LANES)
      at += footprints(v.camera, in, (uint32_t)i, (int)std::min<size_t>(LANES, end - i), tally, &v.input[at], &v.id[at]);
    v.segments[w] = {first, at};
    std::copy(tally, tally + CULL_REASONS, &culled[(size_t)w * CULL_REASONS]);
  });
  v.drawn = 0;
  for (auto& segment : v.segments) v.drawn += segment.end - segment.begin;
  for (int r = 0; r < CULL_REASONS; r++) {
    v.culled[r] = 0;
    for (int w = 0; w < threads; w++) v.culled[r] += culled[(size_t)w * CULL_REASONS + r];
  }
}

// Stable, so Gaussians of one depth keep their input order. Depths are positive: their bits sort as integers.
static void sort_by_depth(View& v, Scratch& s, int threads) {
  constexpr int DIGIT = 11, VALUES = 1 << DIGIT;
  s.keys.resize(v.drawn), s.other.resize(v.drawn), s.order.resize(v.drawn);
  std::vector<size_t> begin(threads, 0);
  for (int w = 1; w < threads; w++) begin[w] = begin[w - 1] + v.segments[w - 1].end - v.segments[w - 1].begin;
  parallel(threads, [&](int w) {
    uint64_t* key = s.keys.p + begin[w];
    for (size_t i = v.segments[w].begin; i < v.segments[w].end; i++) {
      uint32_t u;
      std::memcpy(&u, &v.input[i].z, 4);
      *key++ = (uint64_t)u << 32 | (uint32_t)i;
    }
  });
  uint64_t *from = s.keys.p, *to = s.other.p;
  std::vector<uint32_t> next((size_t)threads * VALUES);
  for (int shift = 32; shift < 64; shift += DIGIT) {
    auto digit = [&](uint64_t key) { return (key >> shift) & (VALUES - 1); };
    parallel(threads, [&](int w) {
      uint32_t* histogram = &next[(size_t)w * VALUES];
      std::fill(histogram, histogram + VALUES, 0);
      for (size_t i = share(v.drawn, w, threads), end = share(v.drawn, w + 1, threads); i < end; i++) histogram[digit(from[i])]++;
    });
    uint32_t sum = 0;
    for (int value = 0; value < VALUES; value++)
      for (int w = 0; w < threads; w++) sum += std::exchange(next[(size_t)w * VALUES + value], sum);
    parallel(threads, [&](int w) {
      uint32_t* place = &next[(size_t)w * VALUES];
      for (size_t i = share(v.drawn, w, threads), end = share(v.drawn, w + 1, threads); i < end; i++)
        to[place[digit(from[i])]++] = from[i];
    });
    std::swap(from, to);
  }
  for (size_t i = 0; i < v.drawn; i++) s.order[i] = (uint32_t)from[i];
}

// One counting sort of (tile, footprint) pairs in depth order: tiles need no sort of their own.
static void bin(View& v, Scratch& s, int threads) {
  const size_t n = v.drawn, tiles = (size_t)v.tiles_x * v.tiles_y;
  v.tile_begin.resize(tiles + 1);
  while ((int)s.tiles.size() < threads) s.tiles.push_back(std::make_unique<Buffer<uint32_t>>());
  s.histogram.resize(std::max((size_t)threads, s.histogram.size()));
  std::vector<size_t> totals(threads);
  parallel(threads, [&](int w) {
    auto& histogram = s.histogram[w];
    auto& list = *s.tiles[w];
    histogram.assign(tiles, 0);
    size_t at = 0, end = share(n, w + 1, threads);
    for (size_t i = share(n, w, threads); i < end; i++) {
      if (i + 8 < end) __builtin_prefetch(&v.input[s.order[i + 8]]);
      size_t before = at;
      if (at + tiles > list.capacity) list.reserve(2 * list.capacity + tiles + 1024, at);
      for_tiles(v.input[s.order[i]], v.tiles_x, v.tiles_y, [&](int t) { histogram[t]++, list[at++] = t; });
      v.slot_end[s.order[i]] = (uint32_t)(at - before);
    }
    totals[w] = at;
  });
  size_t total = 0;
  for (size_t t : totals) total += t;
  if (total >= UINT32_MAX) throw std::bad_alloc();
  uint32_t sum = 0;
  for (size_t i = 0; i < v.slot_end.n; i++) v.slot_end[i] = sum += v.slot_end[i];
  sum = 0;
  for (size_t t = 0; t < tiles; t++) {
    v.tile_begin[t] = sum;
    for (int w = 0; w < threads; w++) {
      sum += std::exchange(s.histogram[w][t], sum);
    }
  }
  v.tile_begin[tiles] = sum;
  v.pairs.resize(sum);
  parallel(threads, [&](int w) {
    auto& next = s.histogram[w];
    const uint32_t* tile = s.tiles[w]->p;
    for (size_t i = share(n, w, threads), end = share(n, w + 1, threads); i < end; i++) {
      uint32_t place = s.order[i], slot = place ? v.slot_end[place - 1] : 0;
      for (; slot < v.slot_end[place]; slot++) v.pairs[next[*tile++]++] = Pair{place, slot};
    }
  });
}

template <class F>
static void for_each_tile(const View& v, int threads, F f) {
  std::atomic<int> next{0};
  int tiles = v.tiles_x * v.tiles_y;
  parallel(threads, [&](int) {
    for (int t; (t = next.fetch_add(8)) < tiles;)
      for (int k = t; k < std::min(t + 8, tiles); k++) f(k, k % v.tiles_x * TILE, k / v.tiles_x * TILE);
  });
}

template <bool COUNT = false>
static long long blend(View& v, int threads, float* color, float* alpha, float* depth) {
  std::atomic<long long> contributions{0};
  for_each_tile(v, threads, [&](int t, int X, int Y) {
    const Pair* pairs = v.pairs.p + v.tile_begin[t];
    long long changed = 0;
    v.taken[t] = blend_forward<COUNT>(v.input.p, pairs, v.pairs.p + v.tile_begin[t + 1], X, Y, v.camera.width, v.camera.height,
                                      v.visited.p + v.tile_begin[t], v.reached.p, color, alpha, depth, changed);
    if (COUNT) contributions += changed;
  });
  return contributions;
}

static void forward(View& v, Scratch& s, const GaussianArrays& in, int threads, float* color, float* alpha, float* depth) {
  project_all(v, in, threads);
  sort_by_depth(v, s, threads);
  bin(v, s, threads);
  v.visited.resize(v.pairs.n), v.reached.resize(v.pairs.n), v.taken.resize((size_t)v.tiles_x * v.tiles_y);
  std::memset(v.reached.p, 0, v.reached.n);
  blend(v, threads, color, alpha, depth);
}

// Which lane of `sums` holds which sum: found by trying, the folds permute.
static std::vector<int> lane_of_sums() {
  std::vector<int> lane(SUMS);
  for (int k = 0; k < SUMS; k++) {
    Lanes x[SUMS] = {};
    x[k] = broadcast(1.f / LANES);
    Lanes r = sums(x);
    for (int i = 0; i < LANES; i++)
      if (r[i] > 0.5f) lane[k] = i;
  }
  return lane;
}

struct Gradients {
  float *means, *scales, *quats, *opacities, *colors;

  void clear(size_t count, int threads) {
    const std::pair<float*, size_t> all[] = {{means, 3}, {scales, 3}, {quats, 4}, {opacities, 1}, {colors, 3}};
    for (auto [p, entries] : all) prefer_huge_pages(p, 4 * entries * count);
    parallel(threads, [&](int w) {
      for (auto [p, entries] : all) std::fill(p + share(entries * count, w, threads), p + share(entries * count, w + 1, threads), 0.f);
    });
  }
  void add(const GradientList& list) {
    for (size_t at = 0; at < list.id.size(); at++) {
      auto x = [&](int k) { return list.gradient[at / LANES * ATTRIBUTES + k][(int)(at % LANES)]; };
      const size_t i = list.id[at];
      for (int k = 0; k < 3; k++)
        means[3 * i + k] += x(MEAN + k), scales[3 * i + k] += x(SCALE + k), colors[3 * i + k] += x(COLOR + k);
      for (int k = 0; k < 4; k++) quats[4 * i + k] += x(QUAT + k);
      opacities[i] += x(OPACITY);
    }
  }
};

// Leaves a list of gradients for each thread in the scratch.
static void backward(View& v, Scratch& s, const GaussianArrays& in, int threads, Images out, Images grad) {
  static const std::vector<int> lane = lane_of_sums();
  s.slots.resize(v.pairs.n);
  while ((int)s.gradients.size() < threads) s.gradients.push_back(gradients_shelf().take());
  for_each_tile(v, threads, [&](int t, int X, int Y) {
    const Pair* pairs = v.pairs.p + v.tile_begin[t];
    blend_backward(v.input.p, pairs, pairs + v.taken[t], X, Y, v.camera.width, v.camera.height,
                   v.visited.p + v.tile_begin[t], out, grad, s.slots.p);
  });
  parallel(threads, [&](int w) {
    uint32_t place[LANES], id[LANES];
    Lanes sum[SUMS] = {}, gradient[ATTRIBUTES];
    int filled = 0;
    const size_t begin = share(v.input.n, w, threads), end = share(v.input.n, w + 1, threads);
    GradientList& list = *s.gradients[w];
    list.id.clear(), list.gradient.resize(((end - begin) / LANES + 1) * ATTRIBUTES);
    auto flush = [&] {
      for (int i = filled; i < LANES; i++) place[i] = place[0];
      for (int i = 0; i < LANES; i++) id[i] = v.id[place[i]];
      project_backward(v.camera, in, id, v.input.p, place, sum, gradient);
      std::copy(gradient, gradient + ATTRIBUTES, &list.gradient[list.id.size() / LANES * ATTRIBUTES]);
      list.id.insert(list.id.end(), id, id + filled);
      filled = 0;
    };
    for (size_t i = begin; i < end; i++) {
      Lanes total{};
      bool any = false;
      for (uint32_t k = i ? v.slot_end[i - 1] : 0; k < v.slot_end[i]; k++)
        if (v.reached[k]) total += s.slots[k], any = true;
      if (!any) continue;
      for (int k = 0; k < SUMS; k++) sum[k][filled] = total[lane[k]];
      place[filled++] = (uint32_t)i;
      if (filled == LANES) flush();
    }
    if (filled) flush();
  });
}

struct Batch {
  std::vector<std::unique_ptr<View>> views;
};

// work(view, worker, threads inside): whole views side by side, a thread each, as far as they go round; the rest one by
// one, with all threads inside.
template <class F>
static void for_each_view(int views, int threads, F work) {
  const int beside = threads > 1 ? views / threads * threads : 0;
  std::atomic<int> next{0};
  if (beside) parallel(threads, [&](int w) {
    for (int v; (v = next++) < beside;) work(v, w, 1);
  });
  for (int v = beside; v < views; v++) work(v, 0, threads);
}

// Adds up the views' gradients in the order of the views, so that sums do not depend on threads. Nobody waits: what comes
// before its turn is kept.
class InOrder {
 public:
  explicit InOrder(Gradients sum) : sum_(sum) {}
  void add(int view, Scratch& s, int threads) {
    if (threads > 1) {  // alone: each thread has Gaussians of its own
      parallel(threads, [&](int w) { sum_.add(*s.gradients[w]); });
      next_ = view + 1;
      return;
    }
    std::lock_guard<std::mutex> lock(guard_);
    waiting_[view] = std::exchange(s.gradients[0], gradients_shelf().take());
    for (auto first = waiting_.begin(); first != waiting_.end() && first->first == next_; first = waiting_.erase(first), next_++) {
      sum_.add(*first->second);
      gradients_shelf().give(std::move(first->second));
    }
  }

 private:
  Gradients sum_;
  std::mutex guard_;
  std::map<int, std::unique_ptr<GradientList>> waiting_;
  int next_ = 0;
};

struct ScratchSet {
  std::vector<std::unique_ptr<Scratch>> of;
  explicit ScratchSet(int n) { while (n--) of.push_back(scratch_shelf().take()); }
  ~ScratchSet() {
    for (; !of.empty(); of.pop_back()) scratch_shelf().give(std::move(of.back()));  // the first is taken first again
  }
};

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

extern "C" {

// poses [V, 4, 4] chunk to camera, lenses [V, 4] fx fy cx cy; color [V, H, W, 3], alpha and depth [V, H, W];
// culled [4] is added to. With `batch`, the state for genre_backward is kept there until genre_free.
int genre_forward(int count, const float* means, const float* scales, const float* quats, const float* opacities,
                  const float* colors, int views, const float* poses, const float* lenses, int width, int height, int threads,
                  float* color, float* alpha, float* depth, long long* culled, void** batch) {
  return guarded([&] {
    GaussianArrays in{count, means, scales, quats, opacities, colors};
    ScratchSet scratch(std::max(1, threads));
    auto kept = std::make_unique<Batch>();
    kept->views.resize(views);
    size_t pixels = (size_t)width * height;
    prefer_huge_pages(color, 12 * pixels * views), prefer_huge_pages(alpha, 4 * pixels * views);
    prefer_huge_pages(depth, 4 * pixels * views);
    std::mutex counting;
    for_each_view(views, std::max(1, threads), [&](int v, int w, int inside) {
      auto view = views_shelf().take();
      view->camera = make_camera(poses + 16 * v, lenses + 4 * v, width, height);
      view->tiles_x = (width + TILE - 1) / TILE, view->tiles_y = (height + TILE - 1) / TILE;
      forward(*view, *scratch.of[w], in, inside, color + 3 * pixels * v, alpha + pixels * v, depth + pixels * v);
      std::lock_guard<std::mutex> lock(counting);
      for (int r = 0; r < CULL_REASONS; r++) culled[r] += view->culled[r];
      if (batch) kept->views[v] = std::move(view);
      else views_shelf().give(std::move(view));
    });
    if (batch) *batch = kept.release();
  });
}

// `color`, `alpha`, `depth` are what genre_forward wrote.
int genre_backward(void* batch, int count, const float* means, const float* scales, const float* quats,
                   const float* opacities, const float* colors, const float* color, const float* alpha, const float* depth,
                   const float* v_color, const float* v_alpha, const float* v_depth, int threads, float* grad_means,
                   float* grad_scales, float* grad_quats, float* grad_opacities, float* grad_colors) {
  return guarded([&] {
    auto& views = static_cast<Batch*>(batch)->views;
    GaussianArrays in{count, means, scales, quats, opacities, colors};
    Gradients g{grad_means, grad_scales, grad_quats, grad_opacities, grad_colors};
    g.clear((size_t)count, std::max(1, threads));
    ScratchSet scratch(std::max(1, threads));
    InOrder sum(g);
    for_each_view((int)views.size(), std::max(1, threads), [&](int v, int w, int inside) {
      size_t at = (size_t)views[v]->camera.width * views[v]->camera.height * v;
      backward(*views[v], *scratch.of[w], in, inside, Images{color + 3 * at, alpha + at, depth + at},
               Images{v_color + 3 * at, v_alpha + at, v_depth + at});
      sum.add(v, *scratch.of[w], inside);
    });
  });
}

// Adds to work [4] what the forward pass did: footprints drawn, (tile, footprint) pairs, pixels computed, pixels changed.
int genre_work(void* batch, long long* work) {
  return guarded([&] {
    for (auto& view : static_cast<Batch*>(batch)->views) {
      View& v = *view;
      std::vector<float> image((size_t)v.camera.width * v.camera.height * 5);
      float* alpha = image.data() + image.size() / 5 * 3;
      work[3] += blend<true>(v, 1, image.data(), alpha, alpha + image.size() / 5);
      work[0] += v.drawn, work[1] += v.pairs.n;
      for (size_t t = 0; t < v.taken.n; t++)
        for (int i = 0; i < v.taken[t]; i++) work[2] += LANES * __builtin_popcount(v.visited[v.tile_begin[t] + i]);
    }
  });
}

void genre_free(void* batch) {
  auto* b = static_cast<Batch*>(batch);
  for (auto& v : b->views) views_shelf().give(std::move(v));
  delete b;
}

// Of what this library was built, so that a stale one is noticed.
const char* genre_digest() { return SOURCE_DIGEST; }
}
