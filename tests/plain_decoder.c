/* The plain decoder of plain_decoder.py as one would write it in C: weights in half precision, float sums.
   gcc -O3 -march=native -ffast-math -shared -fPIC; every matrix is row-major (outputs, inputs). */
#include <math.h>
#include <string.h>
typedef _Float16 half;
#include <immintrin.h>
#ifdef __AVX512F__
#define LANES 16
#define EXPANDED(p) _mm512_cvtph_ps(_mm256_loadu_si256((const __m256i *)(p)))
#else
#define LANES 8
#define EXPANDED(p) _mm256_cvtph_ps(_mm_loadu_si128((const __m128i *)(p)))
#endif
typedef float floats __attribute__((vector_size(4 * LANES), aligned(4)));

/* inputs: a multiple of 16. Four outputs at a time, as their sums do not wait for each other. */
static void product(const half *w, const float *x, float *y, int outputs, int inputs) {
    for (int o = 0; o < outputs; o += 4) {
        int rows = outputs - o < 4 ? outputs - o : 4;
        floats sums[4] = {{0}, {0}, {0}, {0}};
        for (int i = 0; i < inputs; i += LANES)
            for (int r = 0; r < 4; r++) {
                const half *from = w + (long)(o + (r < rows ? r : 0)) * inputs + i;
                sums[r] += EXPANDED(from) * *(const floats *)(x + i);
            }
        for (int r = 0; r < rows; r++) {
            y[o + r] = 0;
            for (int i = 0; i < LANES; i++) y[o + r] += sums[r][i];
        }
    }
}

static void norm(const float *x, const float *gain, float *y, int n) {
    float sum = 0;
    for (int i = 0; i < n; i++) sum += x[i] * x[i];
    float factor = 1 / sqrtf(sum / n + 1e-5f);
    for (int i = 0; i < n; i++) y[i] = x[i] * factor * gain[i];
}

/* E width, F hidden units, V tokens. weights: qkv, out, gate_up, down of each layer, then the head, end to end. gains:
   (2 layers + 1, E). keys, values: (layers, heads, slots, C), `length` of them valid. tokens[0] is given, count follow. */
void decode(const half *weights, const float *gains, const float *embedding, float *keys, float *values, int *tokens,
            int count, int layers, int E, int F, int heads, int V, int slots, int length) {
    int C = E / heads;
    float cosine[C / 2], sine[C / 2], x[E], y[E], qkv[3 * E], mixed[E], gate[2 * F], logits[V], scores[slots];
    for (int n = 0; n < count; n++, length++) {
        const half *w = weights;
        for (int c = 0; c < C / 2; c++) {
            float angle = length * powf(10000, -2.0f * c / C);
            cosine[c] = cosf(angle), sine[c] = sinf(angle);
        }
        memcpy(x, embedding + (long)tokens[n] * E, sizeof x);
        for (int l = 0; l < layers; l++) {
            norm(x, gains + 2 * l * E, y, E);
            product(w, y, qkv, 3 * E, E), w += 3 * E * E;
            for (int h = 0; h < 2 * heads; h++)
                for (int c = 0; c < C / 2; c++) {
                    float *a = qkv + h * C + c, *b = a + C / 2, t = *a;
                    *a = t * cosine[c] - *b * sine[c], *b = *b * cosine[c] + t * sine[c];
                }
            for (int h = 0; h < heads; h++) {
                float *k = keys + (long)(l * heads + h) * slots * C, *v = values + (k - keys), most = -1e30f, total = 0;
                memcpy(k + length * C, qkv + E + h * C, C * sizeof(float));
                memcpy(v + length * C, qkv + 2 * E + h * C, C * sizeof(float));
                for (int s = 0; s <= length; s++) {
                    float sum = 0;
                    for (int c = 0; c < C; c++) sum += qkv[h * C + c] * k[s * C + c];
                    scores[s] = sum / sqrtf(C);
                    most = fmaxf(most, scores[s]);
                }
                for (int s = 0; s <= length; s++) total += scores[s] = expf(scores[s] - most);
                memset(mixed + h * C, 0, C * sizeof(float));
                for (int s = 0; s <= length; s++)
                    for (int c = 0; c < C; c++) mixed[h * C + c] += scores[s] / total * v[s * C + c];
            }
            product(w, mixed, y, E, E), w += E * E;
            for (int i = 0; i < E; i++) x[i] += y[i];
            norm(x, gains + (2 * l + 1) * E, y, E);
            product(w, y, gate, 2 * F, E), w += 2 * F * E;
            for (int i = 0; i < F; i++) gate[i] = gate[i] / (1 + expf(-gate[i])) * gate[F + i];
            product(w, gate, y, E, F), w += E * F;
            for (int i = 0; i < E; i++) x[i] += y[i];
        }
        norm(x, gains + 2 * layers * E, y, E);
        product(w, y, logits, V, E);
        int best = 0;
        for (int i = 1; i < V; i++) best = logits[i] > logits[best] ? i : best;
        tokens[n + 1] = best;
    }
}
