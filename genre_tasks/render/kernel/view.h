// One view, forward and backward: project, sort by depth, bin into tiles, composite.
#pragma once
#include <algorithm>
#include <atomic>
#include <utility>

#include "../../compiled/runtime.h"
#include "blend.h"
#include "memory_pool.h"

// What the backward pass needs of one view.
struct View {
  Camera camera;
  struct VisibleRanges {
    uint32_t shared, begin, count;       // the first `shared` Gaussians, and `count` from `begin` on
  } visible;
  int tiles_x, tiles_y;
  struct Segment {
    size_t begin, end;
  };
  size_t drawn;
  std::vector<Segment> segments;         // entries of `input` that are used: each thread leaves a gap behind its footprints
  Buffer<Footprint> input;               // drawn footprints, in the order of the Gaussians
  Buffer<float> posed_z;                 // by footprint, with a rolling shutter: depth at the pose's time
  Buffer<uint32_t> id, slot_end, tile_begin;  // by footprint: Gaussian, end of its pair slots; by tile: first pair
  Buffer<Pair> pairs;                    // tile after tile, each front to back
  Buffer<uint16_t> visited;              // by pair: blocks that the forward pass visited
  Buffer<uint8_t> reached;               // by slot: whether it visited any
  Buffer<int> pairs_taken;               // by tile: pairs until all rays had ended
  long long culled[CULL_REASONS];
  size_t bytes() const {
    return input.bytes() + posed_z.bytes() + id.bytes() + slot_end.bytes() + tile_begin.bytes() + pairs.bytes() +
           visited.bytes() + reached.bytes() + pairs_taken.bytes();
  }
};

// The gradients of one view's Gaussians that some ray reached: what is hidden has none.
struct GradientList {
  std::vector<uint32_t> id;
  int rows = ATTRIBUTES;   // more with the sums of a residual image behind them
  Buffer<Lanes> gradient;  // [id / LANES, rows], a Gaussian a lane
  size_t bytes() const { return gradient.bytes() + id.capacity() * sizeof(uint32_t); }
};

// Memory that a pass needs only while it runs.
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

template <bool ROLLING_SHUTTER, bool DISTORTION, bool ANTIALIASED>
static void project_all(View& v, const GaussianArrays& in, int threads) {
  const size_t count = (size_t)v.visible.shared + v.visible.count;
  v.input.resize(count), v.id.resize(count), v.slot_end.resize(count);
  if (ROLLING_SHUTTER) v.posed_z.resize(count);
  std::fill(v.slot_end.p, v.slot_end.p + count, 0);
  v.segments.resize(threads);
  std::vector<long long> culled((size_t)threads * CULL_REASONS, 0);
  parallel(threads, [&](int w) {
    size_t first = work_begin(count, w, threads), at = first, end = work_begin(count, w + 1, threads);
    long long tally[CULL_REASONS] = {};
    for (size_t i = first, n; i < end; i += n) {
      const bool shared = i < v.visible.shared;
      n = std::min<size_t>(LANES, (shared ? std::min<size_t>(end, v.visible.shared) : end) - i);
      const size_t id = shared ? i : i - v.visible.shared + v.visible.begin;
      at += footprints<ROLLING_SHUTTER, DISTORTION, ANTIALIASED>(v.camera, in, (uint32_t)id, (int)n, tally, &v.input[at],
                                                                  &v.id[at], ROLLING_SHUTTER ? &v.posed_z[at] : nullptr);
    }
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

// Stable, so Gaussians of one depth keep their input order. Depths are positive: their bits sort as integers. Depths of one
// time: in each row of a rolling shutter all are seen at once, and relative to each other they barely move.
static void sort_by_depth(View& v, Scratch& s, int threads) {
  constexpr int DIGIT = 11, VALUES = 1 << DIGIT;
  constexpr size_t WORTH_A_THREAD = 1 << 17;  // its start costs more than a pass over fewer
  s.keys.resize(v.drawn), s.other.resize(v.drawn), s.order.resize(v.drawn);
  threads = (int)std::min<size_t>(threads, 1 + v.drawn / WORTH_A_THREAD);
  const size_t segments = v.segments.size();
  std::vector<size_t> begin(segments, 0);
  for (size_t k = 1; k < segments; k++) begin[k] = begin[k - 1] + v.segments[k - 1].end - v.segments[k - 1].begin;
  parallel(threads, [&](int w) {
    for (size_t k = w; k < segments; k += threads) {
      uint64_t* key = s.keys.p + begin[k];
      for (size_t i = v.segments[k].begin; i < v.segments[k].end; i++) {
        uint32_t u;
        std::memcpy(&u, v.camera.has_rolling_shutter ? &v.posed_z[i] : &v.input[i].z, 4);
        *key++ = (uint64_t)u << 32 | (uint32_t)i;
      }
    }
  });
  uint64_t *from = s.keys.p, *to = s.other.p;
  std::vector<uint32_t> next((size_t)threads * VALUES);
  for (int shift = 32; shift < 64; shift += DIGIT) {
    auto digit = [&](uint64_t key) { return (key >> shift) & (VALUES - 1); };
    parallel(threads, [&](int w) {
      uint32_t* histogram = &next[(size_t)w * VALUES];
      std::fill(histogram, histogram + VALUES, 0);
      for (size_t i = work_begin(v.drawn, w, threads), end = work_begin(v.drawn, w + 1, threads); i < end; i++)
        histogram[digit(from[i])]++;
    });
    uint32_t sum = 0;
    for (int value = 0; value < VALUES; value++)
      for (int w = 0; w < threads; w++) sum += std::exchange(next[(size_t)w * VALUES + value], sum);
    parallel(threads, [&](int w) {
      uint32_t* footprint_index = &next[(size_t)w * VALUES];
      for (size_t i = work_begin(v.drawn, w, threads), end = work_begin(v.drawn, w + 1, threads); i < end; i++)
        to[footprint_index[digit(from[i])]++] = from[i];
    });
    std::swap(from, to);
  }
  for (size_t i = 0; i < v.drawn; i++) s.order[i] = (uint32_t)from[i];
}

// One counting sort of (tile, footprint) pairs in depth order: tiles need no sort of their own.
static void bin_into_tiles(View& v, Scratch& s, int threads) {
  const size_t n = v.drawn, tiles = (size_t)v.tiles_x * v.tiles_y;
  v.tile_begin.resize(tiles + 1);
  while ((int)s.tiles.size() < threads) s.tiles.push_back(std::make_unique<Buffer<uint32_t>>());
  s.histogram.resize(std::max((size_t)threads, s.histogram.size()));
  std::vector<size_t> totals(threads);
  parallel(threads, [&](int w) {
    auto& histogram = s.histogram[w];
    auto& list = *s.tiles[w];
    histogram.assign(tiles, 0);
    size_t at = 0, end = work_begin(n, w + 1, threads);
    for (size_t i = work_begin(n, w, threads); i < end; i++) {
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
    for (size_t i = work_begin(n, w, threads), end = work_begin(n, w + 1, threads); i < end; i++) {
      uint32_t footprint_index = s.order[i], slot = footprint_index ? v.slot_end[footprint_index - 1] : 0;
      for (; slot < v.slot_end[footprint_index]; slot++) v.pairs[next[*tile++]++] = Pair{footprint_index, slot};
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
    v.pairs_taken[t] = blend_forward<COUNT>(v.input.p, pairs, v.pairs.p + v.tile_begin[t + 1], X, Y, v.camera.width,
                                            v.camera.height, v.visited.p + v.tile_begin[t], v.reached.p, color, alpha, depth,
                                            changed);
    if (COUNT) contributions += changed;
  });
  return contributions;
}

static void forward(View& v, Scratch& s, const GaussianArrays& in, int threads, float* color, float* alpha, float* depth) {
  specialise_for(v.camera, [&](auto has_rolling_shutter, auto has_distortion, auto antialiased) {
    project_all<has_rolling_shutter, has_distortion, antialiased>(v, in, threads);
  });
  sort_by_depth(v, s, threads);
  bin_into_tiles(v, s, threads);
  v.visited.resize(v.pairs.n), v.reached.resize(v.pairs.n), v.pairs_taken.resize((size_t)v.tiles_x * v.tiles_y);
  std::memset(v.reached.p, 0, v.reached.n);
  blend(v, threads, color, alpha, depth);
}

// Which lane of `sums` holds which sum: found by trying, the folds permute.
static std::vector<int> lane_of_sums() {
  std::vector<int> lane(ALL_SUMS);
  for (int k = 0; k < ALL_SUMS; k++) {
    Lanes x[ALL_SUMS] = {};
    x[k] = broadcast(1.f / LANES);
    Lanes r = sums(x);
    for (int i = 0; i < LANES; i++)
      if (r[i] > 0.5f) lane[k] = i;
  }
  return lane;
}

template <bool ROLLING_SHUTTER, bool DISTORTION, bool ANTIALIASED>
static void project_all_backward(const View& v, Scratch& s, const GaussianArrays& in, bool residuals, int threads) {
  static const std::vector<int> lane = lane_of_sums();
  parallel(threads, [&](int w) {
    uint32_t footprint_index[LANES], id[LANES];
    Lanes sum[SUMS] = {}, gradient[ATTRIBUTES], residual_sum[RESIDUAL_SUMS] = {};
    const int rows = ATTRIBUTES + (residuals ? RESIDUAL_SUMS : 0);
    int filled = 0;
    const size_t begin = work_begin(v.input.n, w, threads), end = work_begin(v.input.n, w + 1, threads);
    GradientList& list = *s.gradients[w];
    list.id.clear(), list.rows = rows, list.gradient.resize(((end - begin) / LANES + 1) * rows);
    auto flush = [&] {
      for (int i = filled; i < LANES; i++) footprint_index[i] = footprint_index[0];
      for (int i = 0; i < LANES; i++) id[i] = v.id[footprint_index[i]];
      project_backward<ROLLING_SHUTTER, DISTORTION, ANTIALIASED>(v.camera, in, id, v.input.p, footprint_index, sum, gradient);
      Lanes* out = &list.gradient[list.id.size() / LANES * rows];
      std::copy(gradient, gradient + ATTRIBUTES, out);
      std::copy(residual_sum, residual_sum + rows - ATTRIBUTES, out + ATTRIBUTES);
      list.id.insert(list.id.end(), id, id + filled);
      filled = 0;
    };
    for (size_t i = begin; i < end; i++) {
      Lanes total{};
      bool any = false;
#ifdef GENRE_ABLATE_DETERMINISM
      for (uint32_t k = i ? v.slot_end[i - 1] : 0; k < v.slot_end[i]; k++) any |= v.reached[k] != 0;
      if (any) total = s.slots[i];
#else
      for (uint32_t k = i ? v.slot_end[i - 1] : 0; k < v.slot_end[i]; k++)
        if (v.reached[k]) total += s.slots[k], any = true;
#endif
      if (!any) continue;
      for (int k = 0; k < SUMS; k++) sum[k][filled] = total[lane[k]];
      if (residuals)
        for (int k = 0; k < RESIDUAL_SUMS; k++) residual_sum[k][filled] = total[lane[SUMS + k]];
      footprint_index[filled++] = (uint32_t)i;
      if (filled == LANES) flush();
    }
    if (filled) flush();
  });
}

// Leaves a list of gradients for each thread in the scratch; where there is a `residual` [H, W, 3], with its sums times
// view_weight.
static void backward(View& v, Scratch& s, const GaussianArrays& in, int threads, Images out, Images grad,
                     const float* residual, float view_weight) {
#ifdef GENRE_ABLATE_DETERMINISM
  s.slots.resize(v.input.n), std::fill(s.slots.p, s.slots.p + s.slots.n, Lanes{});
#else
  s.slots.resize(v.pairs.n);
#endif
  while ((int)s.gradients.size() < threads) s.gradients.push_back(std::make_unique<GradientList>());
  for_each_tile(v, threads, [&](int t, int X, int Y) {
    const Pair* pairs = v.pairs.p + v.tile_begin[t];
    const auto blend = residual ? blend_backward<true> : blend_backward<false>;
    blend(v.input.p, pairs, pairs + v.pairs_taken[t], X, Y, v.camera.width, v.camera.height, v.visited.p + v.tile_begin[t], out,
          grad, residual, view_weight, s.slots.p);
  });
  specialise_for(v.camera, [&](auto has_rolling_shutter, auto has_distortion, auto antialiased) {
    project_all_backward<has_rolling_shutter, has_distortion, antialiased>(v, s, in, residual != nullptr, threads);
  });
}
