// The learned optimiser's step in one call: features, a dense layer for each Gaussian, the UNet over voxels, the head. The
// torch code in learned.py, features.py and sparse_unet.py is its oracle. Every number is made by one thread, in an order
// that does not depend on how many there are.
#include "../../compiled/runtime.h"
#include "thread_team.h"
#include "features.h"

// The structures hold pointers and 64-bit numbers only, in the order of fused_library.py.

// output[o] = residual[o] + silu(bias + sum over the pairs (i, k) of o: input[i] @ weight[k]).
struct Layer {
  const float *input, *weight, *bias;  // weight [K, in, out], bias [out]; channels are multiples of LANES
  const float* residual;               // or null
  float* output;                       // [outputs, out]
  const int32_t *starts, *pairs;       // [outputs + 1], and [P, 2] by output: input voxel, kernel offset
  int64_t outputs, in, out, activated;
};

struct Network {
  int64_t hidden;                   // a multiple of 2 * LANES
  int64_t varying;                  // VARYING, or with those of residuals
  const float *entry, *entry_bias;  // [varying + TIMES, hidden]
  const float* mix;                 // [hidden, hidden]: of the own row; voxels bring the bias
  const float *head, *head_bias;    // [hidden, HEAD]: 14 gains, the relaxation and a zero, 14 offsets, two zeros
};

struct Scene {
  int64_t voxels;
  const float *base, *fixed;                // [N, 14] and [N, 4], see features()
  const int32_t *voxel_of, *starts, *points;  // [N]; [voxels + 1] and [N]: each voxel's Gaussians
  int32_t *active, *slot;                   // [N]: Gaussians that are seen now, and the place of each of all there or -1
  float *own, *pooled;                      // [N up to a whole BLOCK, hidden] by slot, [voxels, hidden]
  const float* around;                      // [voxels, hidden]: what the last layer writes, the mixing layer's bias included
  const Layer* layers;
  int64_t layer_count;
};

constexpr int HEAD = 2 * LANES;
constexpr int SUMMED = 1024;  // Gaussians summed in float32 before double takes over
constexpr int VOXELS = 8;     // that a thread takes at once

static size_t pieces(int64_t n, int size) { return ((size_t)n + size - 1) / size; }

static void pool(const Scene& scene, size_t hidden, size_t voxel) {
  const int32_t *begin = scene.points + scene.starts[voxel], *end = scene.points + scene.starts[voxel + 1];
  int seen = 0;
  for (const int32_t* p = begin; p < end; p++) seen += scene.slot[*p] >= 0;
  const Lanes count = broadcast((float)std::max(seen, 1));
  for (size_t c = 0; c < hidden; c += 2 * LANES) {
    Lanes a{}, b{};
    for (const int32_t* p = begin; p < end; p++) {
      if (scene.slot[*p] < 0) continue;
      const float* own = scene.own + scene.slot[*p] * hidden + c;
      a += load(own), b += load(own + LANES);
    }
    float* out = scene.pooled + voxel * hidden + c;
    store(out, a / count), store(out + LANES, b / count);
  }
}

static void convolve(const Layer& layer, size_t o) {
  for (int64_t column = 0; column < layer.out; column += LANES) {
    Lanes sum[4] = {load(layer.bias + column)};  // one chain of additions would wait for itself
    for (int32_t p = layer.starts[o]; p < layer.starts[o + 1]; p++) {
      const float* x = layer.input + layer.pairs[2 * p] * layer.in;
      const float* w = layer.weight + layer.pairs[2 * p + 1] * layer.in * layer.out + column;
      for (int64_t c = 0; c < layer.in; c += 4)
        for (int j = 0; j < 4; j++) sum[j] += x[c + j] * load(w + (c + j) * layer.out);
    }
    Lanes y = (sum[0] + sum[1]) + (sum[2] + sum[3]);
    if (layer.activated) y = silu(y);
    const size_t at = o * layer.out + column;
    store(layer.output + at, layer.residual ? load(layer.residual + at) + y : y);
  }
}

// A thread's own rows.
struct Rows {
  std::vector<Lanes> features, hidden, head;
  explicit Rows(size_t width) : features(BLOCK * STRIDE / LANES), hidden(BLOCK * width / LANES), head(BLOCK * HEAD / LANES) {}
  static float* of(std::vector<Lanes>& rows) { return reinterpret_cast<float*>(rows.data()); }
};
static_assert(BLOCK % TILE_ROWS == 0, "whole tiles");

// What this iteration's views saw is all that moves; the rest has no part in the network. Returns how many these are.
static size_t find_active(const Scene& scene, const Now& now) {
  size_t n = 0;
  for (int64_t i = 0; i < now.count; i++) {
    const bool seen = now.seen_now[i] > 0;
    scene.slot[i] = seen ? (int32_t)n : -1;
    if (seen)
      scene.active[n++] = (int32_t)i;
    else
      store_attributes(now.delta + ATTRIBUTES * i, Lanes{});
  }
  return n;
}

static void enter(const Network& net, const Scene& scene, const Now& now, const Lanes& usual, const float* bias, size_t active,
                  size_t block, Rows& rows) {
  const size_t begin = block * BLOCK, n = std::min<size_t>(BLOCK, active - begin);
  float *x = Rows::of(rows.features), *own = scene.own + begin * net.hidden;
  for (size_t r = 0; r < n; r++) features(now, scene.base, scene.fixed, usual, scene.active[begin + r], x + STRIDE * r);
  dense((int)n, x, STRIDE, (int)net.varying, net.entry, net.hidden, [&](int) { return bias; }, own);
  silu_rows(own, n * net.hidden);
}

static void leave(const Network& net, const Scene& scene, const Now& now, size_t active, size_t block, Rows& rows) {
  const size_t begin = block * BLOCK, n = std::min<size_t>(BLOCK, active - begin);
  const int depth = (int)net.hidden;
  float *hidden = Rows::of(rows.hidden), *head = Rows::of(rows.head);
  const size_t ahead = std::min<size_t>(2 * BLOCK, active - begin) * net.hidden;  // this block and the next
  for (size_t i = 0; i < ahead; i += LANES) __builtin_prefetch(scene.own + begin * net.hidden + i);
  const int32_t* points = scene.active + begin;
  auto around = [&](int r) { return scene.around + scene.voxel_of[points[std::min<size_t>(r, n - 1)]] * net.hidden; };
  dense((int)n, scene.own + begin * net.hidden, net.hidden, depth, net.mix, net.hidden, around, hidden);
  silu_rows(hidden, n * net.hidden);
  dense((int)n, hidden, net.hidden, depth, net.head, HEAD, [&](int) { return net.head_bias; }, head);
  const Lanes rates = load_attributes(now.rates);
  for (size_t r = 0; r < n; r++) {
    const Lanes gain = load(head + HEAD * r), offset = load(head + HEAD * r + LANES);
    const Lanes factor = power_of_2(tanh(gain * (1 / 3.f)) * (3 * LOG2_E));
    float* delta = now.delta + ATTRIBUTES * (size_t)points[r];  // holds the direction
    Lanes step = rates * (factor * load_attributes(delta) + tanh(offset));
    if (now.residuals) step += relaxed(now, (size_t)points[r], tanh(gain)[14]);
    store_attributes(delta, step);
  }
}

static void evaluate(const Network& net, const Scene& scene, const Now& now, int threads) {
  std::vector<Usual> parts(pieces(now.count, SUMMED));
  std::vector<float> bias(net.entry_bias, net.entry_bias + net.hidden);
  for (int t = 0; t < TIMES; t++)
    for (int64_t c = 0; c < net.hidden; c++) bias[c] += now.times[t] * net.entry[(net.varying + t) * net.hidden + c];
  std::vector<Rows> rows(threads, Rows(net.hidden));
  const size_t active = find_active(scene, now), blocks = pieces(active, BLOCK);
  Crew crew(4 + scene.layer_count);
  crew.run(threads, [&](Crew::Member& member) {
    auto each_voxel = [&](int64_t voxels, auto f) {
      member.each(pieces(voxels, VOXELS), [&](size_t p) {
        for (size_t v = p * VOXELS; v < std::min<size_t>((p + 1) * VOXELS, voxels); v++) f(v);
      });
    };
    member.each(parts.size(), [&](size_t p) {
      parts[p] = sum_of_squares(now, p * SUMMED, std::min<size_t>((p + 1) * SUMMED, now.count));
    });
    const Lanes usual = inverse_usual(parts);
    member.each(blocks, [&](size_t b) { enter(net, scene, now, usual, bias.data(), active, b, rows[member.number]); });
    each_voxel(scene.voxels, [&](size_t v) { pool(scene, net.hidden, v); });
    for (int64_t l = 0; l < scene.layer_count; l++)
      each_voxel(scene.layers[l].outputs, [&](size_t v) { convolve(scene.layers[l], v); });
    member.each(blocks, [&](size_t b) { leave(net, scene, now, active, b, rows[member.number]); });
  });
}

// f(i) for each Gaussian.
template <class F>
static void each_gaussian(int64_t count, int threads, F f) {
  const int crew = std::max(1, threads);
  parallel(crew, [&](int w) {
    for (int64_t i = count * w / crew; i < count * (w + 1) / crew; i++) f(i);
  });
}

constexpr int PLANE = 11;

// ground.along_ground: what of a row of 14 leads along its plane (normal, quaternion, the same turned within it), in
// `along`; the row itself off the ground, where the plane is 0.
static const float* along_ground(const float* delta, const float* plane, float* along) {
  const float *normal = plane, *own = plane + 3, *turned = plane + 7;
  if (normal[0] == 0.f && normal[1] == 0.f && normal[2] == 0.f) return delta;
  std::copy(delta, delta + ATTRIBUTES, along);
  float off = 0.f, by_own = 0.f, by_turned = 0.f;
  for (int c = 0; c < 3; c++) off += normal[c] * delta[c];
  for (int c = 0; c < 3; c++) along[c] = delta[c] - normal[c] * off;
  for (int c = 0; c < 4; c++) by_own += own[c] * delta[6 + c], by_turned += turned[c] * delta[6 + c];
  for (int c = 0; c < 4; c++) along[6 + c] = own[c] * by_own + turned[c] * by_turned;
  return along;
}

extern "C" {

// Writes now->delta, the learned optimiser's step: 0 where nothing was seen now.
int genre_network_step(const Network* network, const Scene* scene, const Now* now, int threads) {
  return guarded([&] { evaluate(*network, *scene, *now, std::max(1, threads)); });
}

// Writes now->delta, tuned Adam's step, 0 where nothing was seen now: the bits of an untrained network's.
int genre_adam_step(const Now* now, int threads) {
  return guarded([&] {
    const Lanes rates = load_attributes(now->rates);
    each_gaussian(now->count, threads, [&](int64_t i) {
      if (!(now->seen_now[i] > 0)) return store_attributes(now->delta + ATTRIBUTES * i, Lanes{});
      const float* by_seen = counted(*now, i);
      store_attributes(now->delta + ATTRIBUTES * i, rates * direction(*now, i, by_seen, deviation(*now, i, by_seen)));
    });
  });
}

// State.saw: [N, 14] and [N]; the rates are 1 - decay.
int genre_saw(int64_t count, const float* gradient, const float* first, const float* second, const float* seen,
              float first_rate, float second_rate, int threads, float* new_first, float* new_second, float* new_seen,
              float* seen_now) {
  return guarded([&] {
    each_gaussian(count, threads, [&](int64_t i) {
      const int64_t at = ATTRIBUTES * i;
      const Lanes g = load_attributes(gradient + at), m = load_attributes(first + at), v = load_attributes(second + at);
      const float now = any(~((g >= 0.f) & (g <= 0.f))) ? 1.f : 0.f;  // also where it is NaN
      store_attributes(new_first + at, m + (g - m) * (now * first_rate));
      store_attributes(new_second + at, v + (g * g - v) * (now * second_rate));
      new_seen[i] = seen[i] + now;
      seen_now[i] = now;
    });
  });
}

// State.moved and Frame.bounded: [N, 14], seen_now [N], planes [N, 11]. Off the ground additions and choices only:
// torch's bits.
int genre_moved(int64_t count, const float* offsets, const float* delta, const float* seen_now, const float* start,
                const float* low, const float* high, const float* planes, int threads, float* out) {
  return guarded([&] {
    each_gaussian(count, threads, [&](int64_t i) {
      const int64_t at = ATTRIBUTES * i;
      Lanes moved = load_attributes(offsets + at);
      if (seen_now[i] > 0) {
        float along[ATTRIBUTES];
        moved = moved + load_attributes(along_ground(delta + at, planes + PLANE * i, along));
        const Lanes from = load_attributes(start + at), least = load_attributes(low + at), there = from + moved;
        const Lanes held = bounded(there, least, load_attributes(high + at)), back = held - from;
        const Mask inside = ((there >= held) & (there <= held)) | (least <= -INFINITY);
        moved = select(inside, moved, back);
      }
      store_attributes(out + at, moved);
    });
  });
}

}  // extern "C"
