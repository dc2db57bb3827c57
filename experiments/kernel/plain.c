/* The same network in plain C with the kernel's interface, as a plain for costs:
   plain_step is float32 with the C library's tanhf; plain_step_i16 is int8 with one scale per tensor,
   and its int16 arguments hold int8 values. Without memory: that of a policy is among the observations. */
#include "plain.h"

#include <math.h>

struct layer {
    int inputs, outputs;
    const float *weight, *bias; /* weights [outputs][inputs] */
    const int8_t *weight_i8;
    const int32_t *bias_i32;
    int32_t multiplier; /* accumulator * multiplier >> shift is the next tensor's int8 */
    int shift;
    const int8_t *table; /* of the activation, 256 entries; null for the last layer */
};

#include "plain_data.h"

void plain_reset(plain_state *state) { state->unused = 0; }

int plain_step(plain_state *state, const float obs[PLAIN_OBS_SIZE], float act[PLAIN_ACT_SIZE])
{
    (void)state;
    float values[2][WIDEST];
    const float *x = obs;
    for (int l = 0; l < LAYERS; l++) {
        const struct layer *layer = &layers[l];
        float *y = l == LAYERS - 1 ? act : values[l % 2];
        for (int o = 0; o < layer->outputs; o++) {
            float sum = layer->bias[o];
            for (int i = 0; i < layer->inputs; i++) {
                sum += layer->weight[o * layer->inputs + i] * x[i];
            }
            y[o] = l == LAYERS - 1 ? sum : ACTIVATION(sum);
        }
        x = y;
    }
    return 0;
}

int plain_step_i16(plain_state *state, const int16_t obs[PLAIN_OBS_SIZE], int16_t act[PLAIN_ACT_SIZE])
{
    (void)state;
    int8_t values[2][WIDEST];
    for (int i = 0; i < PLAIN_OBS_SIZE; i++) {
        values[0][i] = (int8_t)obs[i];
    }
    for (int l = 0; l < LAYERS; l++) {
        const struct layer *layer = &layers[l];
        const int8_t *x = values[l % 2];
        int8_t *y = values[(l + 1) % 2];
        for (int o = 0; o < layer->outputs; o++) {
            int32_t sum = layer->bias_i32[o];
            for (int i = 0; i < layer->inputs; i++) {
                sum += layer->weight_i8[o * layer->inputs + i] * x[i];
            }
            int64_t scaled = ((int64_t)sum * layer->multiplier + ((int64_t)1 << (layer->shift - 1))) >> layer->shift;
            int32_t y8 = scaled > 127 ? 127 : scaled < -127 ? -127 : (int32_t)scaled;
            y[o] = layer->table ? layer->table[y8 + 128] : (int8_t)y8;
        }
    }
    for (int o = 0; o < PLAIN_ACT_SIZE; o++) {
        act[o] = values[LAYERS % 2][o];
    }
    return 0;
}

int plain_selftest(void) { return 0; }
