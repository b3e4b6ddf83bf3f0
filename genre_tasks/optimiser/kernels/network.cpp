// The learned optimiser's step in one call: features, a dense layer for each Gaussian, the UNet over voxels, the head. The
// torch code in network.py, features.py and sparse_unet.py is its oracle. Every number is computed by one thread, in an order
// that does not depend on how many there are.
#include "../../compiled/runtime.h"
#include "thread_team.h"
#include "features.h"

// The structures hold pointers and 64-bit numbers only, in the order of library.py.

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
  int64_t varying;                  // VARYING_FEATURES, plus IMAGE_RESIDUALS where the network takes them
  const float *entry, *entry_bias;  // [varying + SCHEDULE_FEATURES, hidden]
  const float* mix;                 // [hidden, hidden]: of the Gaussian's row; voxels bring the bias
  const float *head, *head_bias;    // [hidden, HEAD]: 14 gains, the relaxation and a zero, 14 offsets, two zeros
};

struct Scene {
  int64_t voxels;
  const float *base, *fixed;                // [N, 14] and [N, 4], see features()
  const int32_t *voxel_of, *starts, *points;  // [N]; [voxels + 1] and [N]: each voxel's Gaussians
  int32_t *active, *slot;                   // [N]: the visible Gaussians, and each one's index among them or -1
  float *embedding, *pooled;                // [N rounded up to BLOCK_GAUSSIANS, hidden] by slot, [voxels, hidden]
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
  int visible = 0;
  for (const int32_t* p = begin; p < end; p++) visible += scene.slot[*p] >= 0;
  const Lanes count = broadcast((float)std::max(visible, 1));
  for (size_t c = 0; c < hidden; c += 2 * LANES) {
    Lanes a{}, b{};
    for (const int32_t* p = begin; p < end; p++) {
      if (scene.slot[*p] < 0) continue;
      const float* embedding = scene.embedding + scene.slot[*p] * hidden + c;
      a += load(embedding), b += load(embedding + LANES);
    }
    float* out = scene.pooled + voxel * hidden + c;
    store(out, a / count), store(out + LANES, b / count);
  }
}

static void convolve(const Layer& layer, size_t o) {
  for (int64_t column = 0; column < layer.out; column += LANES) {
    Lanes sum[4] = {load(layer.bias + column)};  // in one chain each addition would wait for the one before
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

// A thread's rows.
struct Rows {
  std::vector<Lanes> features, hidden, head;
  explicit Rows(size_t width) : features(BLOCK_GAUSSIANS * STRIDE / LANES), hidden(BLOCK_GAUSSIANS * width / LANES), head(BLOCK_GAUSSIANS * HEAD / LANES) {}
  static float* of(std::vector<Lanes>& rows) { return reinterpret_cast<float*>(rows.data()); }
};
static_assert(BLOCK_GAUSSIANS % TILE_ROWS == 0, "whole tiles");

// Finds the visible Gaussians: nothing else moves or has a part in the network. Returns how many they are.
static size_t find_active(const Scene& scene, const StepInputs& in) {
  size_t n = 0;
  for (int64_t i = 0; i < in.count; i++) {
    const bool visible = in.visible[i] > 0;
    scene.slot[i] = visible ? (int32_t)n : -1;
    if (visible)
      scene.active[n++] = (int32_t)i;
    else
      store_attributes(in.delta + ATTRIBUTES * i, Lanes{});
  }
  return n;
}

// Embeds a block of Gaussians: their features, and the dense layer on them.
static void embed(const Network& net, const Scene& scene, const StepInputs& in, const Lanes& inverse_group_rms, const float* bias,
                  size_t active, size_t block, Rows& rows) {
  const size_t begin = block * BLOCK_GAUSSIANS, n = std::min<size_t>(BLOCK_GAUSSIANS, active - begin);
  float *x = Rows::of(rows.features), *embedding = scene.embedding + begin * net.hidden;
  for (size_t r = 0; r < n; r++)
    features(in, scene.base, scene.fixed, inverse_group_rms, scene.active[begin + r], x + STRIDE * r);
  dense((int)n, x, STRIDE, (int)net.varying, net.entry, net.hidden, [&](int) { return bias; }, embedding);
  silu_rows(embedding, n * net.hidden);
}

// Mixes a block's embeddings with what is around them, and makes its steps.
static void step(const Network& net, const Scene& scene, const StepInputs& in, size_t active, size_t block, Rows& rows) {
  const size_t begin = block * BLOCK_GAUSSIANS, n = std::min<size_t>(BLOCK_GAUSSIANS, active - begin);
  const int depth = (int)net.hidden;
  float *hidden = Rows::of(rows.hidden), *head = Rows::of(rows.head);
  const size_t ahead = std::min<size_t>(2 * BLOCK_GAUSSIANS, active - begin) * net.hidden;  // this block and the next
  for (size_t i = 0; i < ahead; i += LANES) __builtin_prefetch(scene.embedding + begin * net.hidden + i);
  const int32_t* points = scene.active + begin;
  auto around = [&](int r) { return scene.around + scene.voxel_of[points[std::min<size_t>(r, n - 1)]] * net.hidden; };
  dense((int)n, scene.embedding + begin * net.hidden, net.hidden, depth, net.mix, net.hidden, around, hidden);
  silu_rows(hidden, n * net.hidden);
  dense((int)n, hidden, net.hidden, depth, net.head, HEAD, [&](int) { return net.head_bias; }, head);
  const Lanes rates = load_attributes(in.signed_rates);
  for (size_t r = 0; r < n; r++) {
    const Lanes gain = load(head + HEAD * r), offset = load(head + HEAD * r + LANES);
    const Lanes factor = power_of_2(tanh(gain * (1 / 3.f)) * (3 * LOG2_E));
    float* delta = in.delta + ATTRIBUTES * (size_t)points[r];  // features() has left the direction here
    Lanes step = rates * (factor * load_attributes(delta) + tanh(offset));
    if (in.image_residuals) step += residual_step(in, (size_t)points[r], tanh(gain)[14]);
    store_attributes(delta, step);
  }
}

static void evaluate(const Network& net, const Scene& scene, const StepInputs& in, int threads) {
  std::vector<SquaredRms> parts(pieces(in.count, SUMMED));
  // Features that all Gaussians share are a constant of the dense layer: they go into its bias.
  std::vector<float> bias(net.entry_bias, net.entry_bias + net.hidden);
  for (int t = 0; t < SCHEDULE_FEATURES; t++)
    for (int64_t c = 0; c < net.hidden; c++)
      bias[c] += in.schedule_features[t] * net.entry[(net.varying + t) * net.hidden + c];
  std::vector<Rows> rows(threads, Rows(net.hidden));
  const size_t active = find_active(scene, in), blocks = pieces(active, BLOCK_GAUSSIANS);
  ThreadTeam team(4 + scene.layer_count);
  team.run(threads, [&](ThreadTeam::Member& member) {
    auto each_voxel = [&](int64_t voxels, auto f) {
      member.each(pieces(voxels, VOXELS), [&](size_t p) {
        for (size_t v = p * VOXELS; v < std::min<size_t>((p + 1) * VOXELS, voxels); v++) f(v);
      });
    };
    member.each(parts.size(), [&](size_t p) {
      parts[p] = sum_squared_rms(in, p * SUMMED, std::min<size_t>((p + 1) * SUMMED, in.count));
    });
    const Lanes group_rms = inverse_group_rms(parts);
    member.each(blocks, [&](size_t b) { embed(net, scene, in, group_rms, bias.data(), active, b, rows[member.number]); });
    each_voxel(scene.voxels, [&](size_t v) { pool(scene, net.hidden, v); });
    for (int64_t l = 0; l < scene.layer_count; l++)
      each_voxel(scene.layers[l].outputs, [&](size_t v) { convolve(scene.layers[l], v); });
    member.each(blocks, [&](size_t b) { step(net, scene, in, active, b, rows[member.number]); });
  });
}

// f(i) for each Gaussian.
template <class F>
static void each_gaussian(int64_t count, int threads, F f) {
  const int workers = std::max(1, threads);
  parallel(workers, [&](int w) {
    for (int64_t i = count * w / workers; i < count * (w + 1) / workers; i++) f(i);
  });
}

constexpr int CONSTRAINT = 11;

// project_onto_ground of ground_constraint.py: a row of 14 without what leads out of the ground's plane, in `along`. A
// constraint is the normal, the unit quaternion, and that quaternion after half a turn within the plane. Off the ground it is
// 0, and the row itself is returned.
static const float* project_onto_ground(const float* delta, const float* constraint, float* along) {
  const float *normal = constraint, *quat = constraint + 3, *turned = constraint + 7;
  if (normal[0] == 0.f && normal[1] == 0.f && normal[2] == 0.f) return delta;
  std::copy(delta, delta + ATTRIBUTES, along);
  float off = 0.f, by_quat = 0.f, by_turned = 0.f;
  for (int c = 0; c < 3; c++) off += normal[c] * delta[c];
  for (int c = 0; c < 3; c++) along[c] = delta[c] - normal[c] * off;
  for (int c = 0; c < 4; c++) by_quat += quat[c] * delta[6 + c], by_turned += turned[c] * delta[6 + c];
  for (int c = 0; c < 4; c++) along[6 + c] = quat[c] * by_quat + turned[c] * by_turned;
  return along;
}

// ShState of N Gaussians, [N, K, 3] but for second_moment [N], visit_count [N] and view_counts [N, 3].
struct ShState {
  float *coefficients, *first_moment, *second_moment, *visit_count, *basis_sums, *view_counts;
};

// What one iteration of the spherical harmonics takes; by_colors is [N, 3], by_count as of StepInputs.
struct ShStepInputs {
  int64_t count, sh_count;
  ShState before;
  const float *by_coefficients, *basis_sums, *view_counts, *by_colors, *by_count;
  ShState after;
  float* shift;  // [N, 3]
};

// ShState.apply_step of sh_optimiser.py for Gaussian i: the same sums, entry by entry.
static void sh_step(const ShStepInputs& in, float rate, float first_rate, float second_rate, int64_t i) {
  const ShState &from = in.before, &to = in.after;
  const int64_t entries = 3 * in.sh_count, at = entries * i;
  const float* by_color = in.by_colors + 3 * i;
  const float square = (by_color[0] * by_color[0] + by_color[1] * by_color[1] + by_color[2] * by_color[2]) / 3.f;
  const float now = square > 0 ? 1.f : 0.f, visits = from.visit_count[i] + now;
  const float second = from.second_moment[i] + now * second_rate * (square - from.second_moment[i]);
  const float* bias = in.by_count + 3 * (int64_t)visits;
  const float scale = now / (bias[0] * (std::sqrt(second / bias[1]) + RMS_FLOOR));
  to.visit_count[i] = visits, to.second_moment[i] = second;
  float seen[3], shift[3] = {};
  for (int c = 0; c < 3; c++) {
    const float views = from.view_counts[3 * i + c] + in.view_counts[3 * i + c];
    to.view_counts[3 * i + c] = views;
    seen[c] = views < 1.f ? 1.f : views;
  }
  for (int64_t k = 0; k < entries; k += 3)
    for (int c = 0; c < 3; c++) {
      const int64_t e = at + k + c;
      const float sum = from.basis_sums[e] + in.basis_sums[e], mean = sum / seen[c];
      const float gradient = in.by_coefficients[e] - mean * by_color[c];
      const float moment = from.first_moment[e] + now * first_rate * (gradient - from.first_moment[e]);
      const float direction = moment * scale, step = rate * (direction < -6.f ? -6.f : direction > 6.f ? 6.f : direction);
      to.basis_sums[e] = sum, to.first_moment[e] = moment, to.coefficients[e] = from.coefficients[e] + step;
      shift[c] += mean * step;
    }
  for (int c = 0; c < 3; c++) in.shift[3 * i + c] = -shift[c];
}

extern "C" {

// Writes in->after and in->shift; `rate` is the signed learning rate, the others are 1 - decay.
int genre_sh_step(const ShStepInputs* in, float rate, float first_rate, float second_rate, int threads) {
  return guarded([&] {
    each_gaussian(in->count, threads, [&](int64_t i) { sh_step(*in, rate, first_rate, second_rate, i); });
  });
}

// Writes in->delta, the learned optimiser's step: 0 for Gaussians that are not visible.
int genre_network_step(const Network* network, const Scene* scene, const StepInputs* in, int threads) {
  return guarded([&] { evaluate(*network, *scene, *in, std::max(1, threads)); });
}

// Writes in->delta, tuned Adam's step, 0 for Gaussians that are not visible: the bits of an untrained network's step.
int genre_adam_step(const StepInputs* in, int threads) {
  return guarded([&] {
    const Lanes rates = load_attributes(in->signed_rates);
    each_gaussian(in->count, threads, [&](int64_t i) {
      if (!(in->visible[i] > 0)) return store_attributes(in->delta + ATTRIBUTES * i, Lanes{});
      const float* factors = factors_of_count(*in, i);
      store_attributes(in->delta + ATTRIBUTES * i, rates * adam_direction(*in, i, factors, rms_gradient(*in, i, factors)));
    });
  });
}

// State.accumulate: [N, 14] and [N]; the rates are 1 - decay.
int genre_accumulate(int64_t count, const float* gradient, const float* first_moment, const float* second_moment,
                     const float* visit_count, float first_rate, float second_rate, int threads, float* new_first,
                     float* new_second, float* new_count, float* visible) {
  return guarded([&] {
    each_gaussian(count, threads, [&](int64_t i) {
      const int64_t at = ATTRIBUTES * i;
      const Lanes g = load_attributes(gradient + at), m = load_attributes(first_moment + at);
      const Lanes v = load_attributes(second_moment + at);
      const float now = any(~((g >= 0.f) & (g <= 0.f))) ? 1.f : 0.f;  // also where it is NaN
      store_attributes(new_first + at, m + (g - m) * (now * first_rate));
      store_attributes(new_second + at, v + (g * g - v) * (now * second_rate));
      new_count[i] = visit_count[i] + now;
      visible[i] = now;
    });
  });
}

// State.apply_step and Parameterization.clamp: [N, 14], visible [N], constraints [N, 11]. Off the ground there are additions
// and choices only, so that the bits are torch's.
int genre_apply_step(int64_t count, const float* offsets, const float* delta, const float* visible, const float* initial,
                     const float* lower, const float* upper, const float* constraints, int threads, float* out) {
  return guarded([&] {
    each_gaussian(count, threads, [&](int64_t i) {
      const int64_t at = ATTRIBUTES * i;
      Lanes moved = load_attributes(offsets + at);
      if (visible[i] > 0) {
        float along[ATTRIBUTES];
        moved = moved + load_attributes(project_onto_ground(delta + at, constraints + CONSTRAINT * i, along));
        const Lanes from = load_attributes(initial + at), least = load_attributes(lower + at), there = from + moved;
        const Lanes clamped = bounded(there, least, load_attributes(upper + at)), back = clamped - from;
        const Mask inside = ((there >= clamped) & (there <= clamped)) | (least <= -INFINITY);
        moved = select(inside, moved, back);
      }
      store_attributes(out + at, moved);
    });
  });
}

}  // extern "C"
