// One view, forward and backward: project, sort by depth, bin into tiles, composite; and the way back.
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
  struct Shown {
    uint32_t shared, begin, own;         // Gaussians: the first ones, and where its own begin and how many they are
  } shown;
  int tiles_x, tiles_y;
  struct Segment {
    size_t begin, end;
  };
  size_t drawn;
  std::vector<Segment> segments;         // places in input order that are taken: each thread leaves a gap behind its own
  Buffer<Footprint> input;               // drawn footprints, by place
  Buffer<float> posed_z;                 // by place, with a rolling shutter: depth at the pose's time
  Buffer<uint32_t> id, slot_end, tile_begin;  // by place: Gaussian, end of its pair slots; by tile: first pair
  Buffer<Pair> pairs;                    // tile after tile, each front to back
  Buffer<uint16_t> visited;              // by pair: blocks that the forward pass visited
  Buffer<uint8_t> reached;               // by slot: whether it visited any
  Buffer<int> taken;                     // by tile: pairs until all rays had ended
  long long culled[CULL_REASONS];
  size_t bytes() const {
    return input.bytes() + posed_z.bytes() + id.bytes() + slot_end.bytes() + tile_begin.bytes() + pairs.bytes() +
           visited.bytes() + reached.bytes() + taken.bytes();
  }
};

// The gradients of one view's Gaussians that some ray reached: what is hidden has none.
struct GradientList {
  std::vector<uint32_t> id;
  int rows = ATTRIBUTES;   // or with the sums of a residual image behind them
  Buffer<Lanes> gradient;  // [id / LANES, rows], a Gaussian a lane
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

template <bool ROLLS, bool BENDS, bool SMOOTHS>
static void project_all(View& v, const GaussianArrays& in, int threads) {
  const size_t count = (size_t)v.shown.shared + v.shown.own;
  v.input.resize(count), v.id.resize(count), v.slot_end.resize(count);
  if (ROLLS) v.posed_z.resize(count);
  std::fill(v.slot_end.p, v.slot_end.p + count, 0);
  v.segments.resize(threads);
  std::vector<long long> culled((size_t)threads * CULL_REASONS, 0);
  parallel(threads, [&](int w) {
    size_t first = share(count, w, threads), at = first, end = share(count, w + 1, threads);
    long long tally[CULL_REASONS] = {};
    for (size_t i = first, n; i < end; i += n) {
      const bool shared = i < v.shown.shared;
      n = std::min<size_t>(LANES, (shared ? std::min<size_t>(end, v.shown.shared) : end) - i);
      const size_t id = shared ? i : i - v.shown.shared + v.shown.begin;
      at += footprints<ROLLS, BENDS, SMOOTHS>(v.camera, in, (uint32_t)id, (int)n, tally, &v.input[at], &v.id[at], ROLLS ? &v.posed_z[at] : nullptr);
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
        std::memcpy(&u, v.camera.rolls ? &v.posed_z[i] : &v.input[i].z, 4);
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
  specialised(v.camera, [&](auto rolls, auto bends, auto smooths) { project_all<rolls, bends, smooths>(v, in, threads); });
  sort_by_depth(v, s, threads);
  bin(v, s, threads);
  v.visited.resize(v.pairs.n), v.reached.resize(v.pairs.n), v.taken.resize((size_t)v.tiles_x * v.tiles_y);
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

template <bool ROLLS, bool BENDS, bool SMOOTHS>
static void project_all_backward(const View& v, Scratch& s, const GaussianArrays& in, bool back, int threads) {
  static const std::vector<int> lane = lane_of_sums();
  parallel(threads, [&](int w) {
    uint32_t place[LANES], id[LANES];
    Lanes sum[SUMS] = {}, gradient[ATTRIBUTES], shown[BACK_SUMS] = {};
    const int rows = ATTRIBUTES + (back ? BACK_SUMS : 0);
    int filled = 0;
    const size_t begin = share(v.input.n, w, threads), end = share(v.input.n, w + 1, threads);
    GradientList& list = *s.gradients[w];
    list.id.clear(), list.rows = rows, list.gradient.resize(((end - begin) / LANES + 1) * rows);
    auto flush = [&] {
      for (int i = filled; i < LANES; i++) place[i] = place[0];
      for (int i = 0; i < LANES; i++) id[i] = v.id[place[i]];
      project_backward<ROLLS, BENDS, SMOOTHS>(v.camera, in, id, v.input.p, place, sum, gradient);
      Lanes* out = &list.gradient[list.id.size() / LANES * rows];
      std::copy(gradient, gradient + ATTRIBUTES, out), std::copy(shown, shown + rows - ATTRIBUTES, out + ATTRIBUTES);
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
      if (back)
        for (int k = 0; k < BACK_SUMS; k++) shown[k][filled] = total[lane[SUMS + k]];
      place[filled++] = (uint32_t)i;
      if (filled == LANES) flush();
    }
    if (filled) flush();
  });
}

// Leaves a list of gradients for each thread in the scratch; where there is a `residual` [H, W, 3], with `share` of its sums.
static void backward(View& v, Scratch& s, const GaussianArrays& in, int threads, Images out, Images grad,
                     const float* residual, float share) {
  s.slots.resize(v.pairs.n);
  while ((int)s.gradients.size() < threads) s.gradients.push_back(std::make_unique<GradientList>());
  for_each_tile(v, threads, [&](int t, int X, int Y) {
    const Pair* pairs = v.pairs.p + v.tile_begin[t];
    const auto blend = residual ? blend_backward<true> : blend_backward<false>;
    blend(v.input.p, pairs, pairs + v.taken[t], X, Y, v.camera.width, v.camera.height, v.visited.p + v.tile_begin[t], out, grad,
          residual, share, s.slots.p);
  });
  specialised(v.camera, [&](auto rolls, auto bends, auto smooths) {
    project_all_backward<rolls, bends, smooths>(v, s, in, residual != nullptr, threads);
  });
}
