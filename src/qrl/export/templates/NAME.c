/*
@banner@
 * See @name@.h for inputs, outputs and the license (unrestricted).
 */

#include "@name@.h"

/*
 * An integer network: int8 weights with one scale per output, int16 activations, int32 accumulators.
 *
 *     acc = bias + sum(weight * x)                    |acc| <= @acc_bound@ for any x: proved at export
 *     y   = saturate(floor(acc * multiplier / 2^(16 + shift)))          the bias includes the rounding half
 *
 * Four implementations with identical results: Arm with Helium (Cortex-M55, M85 ...), with the DSP extension (Cortex-M4,
 * M7, M33 ...), Armv6-M (Cortex-M0, M0+), and C99 for all others.
 */
#if defined(__ARM_FEATURE_MVE) && defined(__GNUC__) && !defined(__ARM_BIG_ENDIAN)
#define BODY_MVE
#include <arm_mve.h>
#elif defined(__ARM_FEATURE_DSP) && defined(__thumb2__) && defined(__GNUC__) && !defined(__ARM_BIG_ENDIAN)
#define BODY_DSP
#elif (defined(__ARM_ARCH_6M__) || defined(__ARM_ARCH_8M_BASE__)) && defined(__GNUC__)
#define BODY_ARMV6M
#endif

#ifdef __GNUC__ /* inlined, these take more stack, flash or time */
#define APART static __attribute__((noinline))
#else
#define APART static
#endif

#if defined(__ARM_FEATURE_SAT) && defined(__GNUC__)
#define SATURATE
#endif

/* The code below shifts negative numbers arithmetically; C99 leaves that to the compiler. */
typedef char needs_arithmetic_right_shift[(-1 >> 1) == -1 ? 1 : -1];

typedef char the_state_has_its_size[sizeof(@name@_state) == @state_size@ ? 1 : -1];

#ifdef BODY_ARMV6M
/* No load of bytes there extends their sign, and no other instruction is to spare for it. With u = w + 2^7, v = x + 2^15,
   modulo 2^32, sum(u v) = sum(w x) + 2^15 sum(w) + 2^7 sum(v): the second sum is a constant, the third is shared by all
   rows. */
typedef uint16_t activation;
#define OFFSET 32768
#else
typedef int16_t activation;
#define OFFSET 0
#endif

#if defined(BODY_DSP) || defined(BODY_ARMV6M)
typedef uint8_t weight;
typedef uint32_t accumulator;
#else
typedef int8_t weight;
typedef int32_t accumulator;
#endif

#ifdef BODY_DSP /* pairs of halfwords */
typedef uint32_t factors;
#define M2(m0, m1) (m0##u | m1##u << 16)
#define FOUR 2
#else
typedef uint16_t factors;
#define M2(m0, m1) m0, m1
#define FOUR 4
#endif

/* Weights come in tiles of four outputs, a to d: W4 has four inputs, W8 eight. A body lays them out as it reads them. B4
   has the biases of four outputs and the sums of their weights. */
#if defined(BODY_MVE) /* a load has eight inputs of an output */
#define TILE 8
#define W4(a0, a1, a2, a3, b0, b1, b2, b3, c0, c1, c2, c3, d0, d1, d2, d3) \
    W8(a0, a1, a2, a3, 0, 0, 0, 0, b0, b1, b2, b3, 0, 0, 0, 0, c0, c1, c2, c3, 0, 0, 0, 0, d0, d1, d2, d3, 0, 0, 0, 0)
#define W8(...) __VA_ARGS__
#define B4(a, sum_a, b, sum_b, c, sum_c, d, sum_d) a, b, c, d
#else
#define TILE 4
#define W8(a0, a1, a2, a3, a4, a5, a6, a7, b0, b1, b2, b3, b4, b5, b6, b7, c0, c1, c2, c3, c4, c5, c6, c7, d0, d1, d2, d3, \
           d4, d5, d6, d7)                                                        \
    W4(a0, a1, a2, a3, b0, b1, b2, b3, c0, c1, c2, c3, d0, d1, d2, d3),           \
        W4(a4, a5, a6, a7, b4, b5, b6, b7, c4, c5, c6, c7, d4, d5, d6, d7)
#if defined(BODY_DSP)
/* Halfwords of two outputs: u_a + 2^8 w_b with u = w + 2^7. The sum of their products with x is that of u_a x plus 2^8 times
   that of w_b x, which their upper bytes give: modulo 2^32 the first follows. */
#define W2(a, b) (weight)((a) + 128), (weight)(b)
#define UP(a, b) (uint32_t)(a) + 256u * (uint32_t)(b)
#define B4(a, sum_a, b, sum_b, c, sum_c, d, sum_d) UP(a, b), UP(b, 0), UP(c, d), UP(d, 0)
#define W4(a0, a1, a2, a3, b0, b1, b2, b3, c0, c1, c2, c3, d0, d1, d2, d3) \
    W2(a0, b0), W2(a1, b1), W2(a2, b2), W2(a3, b3), W2(c0, d0), W2(c1, d1), W2(c2, d2), W2(c3, d3)
#elif defined(BODY_ARMV6M)
/* Words of four outputs. The accumulators sum the products with x of the whole word, of it shifted by one byte, by two and
   by three; the fourth is that of the last output, and modulo 2^32 each of the others is its own output's plus 2^8 times the
   next accumulator. */
#define W1(a, b, c, d) (weight)((a) + 128), (weight)((b) + 128), (weight)((c) + 128), (weight)((d) + 128)
#define B1(bias, sum) ((uint32_t)(bias)-32768u * (uint32_t)(sum))
#define B4(a, sum_a, b, sum_b, c, sum_c, d, sum_d)                                                           \
    B1(a, sum_a) + (B1(b, sum_b) << 8) + (B1(c, sum_c) << 16) + (B1(d, sum_d) << 24),                        \
        B1(b, sum_b) + (B1(c, sum_c) << 8) + (B1(d, sum_d) << 16), B1(c, sum_c) + (B1(d, sum_d) << 8), B1(d, sum_d)
#define W4(a0, a1, a2, a3, b0, b1, b2, b3, c0, c1, c2, c3, d0, d1, d2, d3) \
    W1(a0, b0, c0, d0), W1(a1, b1, c1, d1), W1(a2, b2, c2, d2), W1(a3, b3, c3, d3)
#else
#define W4(...) __VA_ARGS__
#define B4(a, sum_a, b, sum_b, c, sum_c, d, sum_d) a, b, c, d
#endif
#endif

#define TANH @tanh@ /* else ReLU */
#define PREVIOUS_ACTION @previous_action@ /* inputs of the network after the observation: the previous action, */
#define INTEGRAL @integral@        /* then the integral of so many components of the error, */
#define POSITIONS @positions@       /* which follows from so many coordinates of the position */
#define UNITS @units@ /* numbers of a recurrent unit before the last layer */
#define MEMORY (PREVIOUS_ACTION || INTEGRAL || UNITS)
#define SEEN @seen@ /* inputs of the network that follow from the observation */
#define TURN @turn@ /* whether they are in the body frame */
#define KEPT @kept@ /* inputs that are remembered */
#define GOLDENS @goldens@

/* So many inputs, in whole tiles. */
#define TILES(inputs) (((inputs) + TILE - 1) / TILE * TILE)
#define WIDEST TILES(@widest@)

union activations {
    activation one[WIDEST];
    int32_t aligned;
};

/* Of four outputs. */
struct outputs {
    accumulator biases[4];
    factors factors[FOUR]; /* below 2^15 */
};

struct layer {
    const weight *weights; /* tiles, along the inputs first */
    const struct outputs *outputs, *end;
    uint16_t inputs; /* inputs and outputs are multiples of 4, padded with zeros */
    uint8_t hidden;  /* 1: the activation follows */
    uint8_t shift;
};

struct input {
    uint16_t scale;
    int16_t exponent; /* 1 / lsb = scale * 2^(141 - exponent) */
    int16_t least;    /* in steps; inputs saturate at least and at least + span */
    uint16_t span;
};

struct golden {
    float obs[@NAME@_OBS_SIZE];
    int16_t obs_i16[@NAME@_OBS_SIZE];
    int16_t act[@NAME@_ACT_SIZE];
    int8_t status, status_i16;
};

struct goldens {
    union {
        uint32_t bits;
        float obs;
    } not_a_number; /* the first of an observation's numbers, of which the others follow */
    struct golden vectors[GOLDENS];
};

#if KEPT
struct kept {
    uint8_t shift; /* an input is a value of the state / 2^shift, */
    int16_t least; /* saturated at least and most */
    int16_t most;
};
#endif

#if INTEGRAL
struct position {
    uint8_t input; /* where it stands in obs, */
    uint8_t shift; /* and its input is the position / 2^shift */
};

struct factor { /* factor / 2^shift */
    uint16_t factor;
    uint8_t shift;
};

struct error {
    uint16_t inverse_radius;
    uint16_t gain;
    uint8_t inverse_radius_shift, gain_shift;
};
#endif

@tables@

/* The sums of four outputs: the biases plus the weights from `w` on times the activations from `x` to `last`. Returns the
   next weights. */
#if defined(BODY_MVE)

struct four {
    accumulator shared;
    int32x4_t sums;
};

#define ROW(a, q)                       \
    "vldrb.s16 " q ", [%[w]], #8\n\t"   \
    "vmladava.s16 %[" a "], " q ", q0\n\t"

static inline const weight *accumulate(struct four *s, const accumulator *biases, const weight *w, const activation *x,
                                       const activation *last) {
    int32_t a0 = biases[0], a1 = biases[1], a2 = biases[2], a3 = biases[3];
    const int eights = (int)(last - x + 7) / 8; /* beyond `last` the weights are 0 */
    __asm__ volatile(
        "dls  lr, %[eights]\n"
        "1:\n\t"
        "vldrh.u16 q0, [%[x]], #16\n\t" ROW("a0", "q1") ROW("a1", "q2") ROW("a2", "q1") ROW("a3", "q2")
        "le   lr, 1b\n\t"
        "vmov %q[sums][2], %q[sums][0], %[a0], %[a2]\n\t"
        "vmov %q[sums][3], %q[sums][1], %[a1], %[a3]"
        : [sums] "=w"(s->sums), [a0] "+Te"(a0), [a1] "+Te"(a1), [a2] "+Te"(a2), [a3] "+Te"(a3), [w] "+r"(w), [x] "+r"(x)
        : [eights] "r"(eights)
        : "q0", "q1", "q2", "lr", "memory");
    return w;
}

#else

struct four {
    accumulator shared, a0, a1, a2, a3;
};

#if defined(BODY_DSP)

/* A word, of two outputs and two inputs. */
#define WORD(word, in, upper, lower)                             \
    "smlad  %[" upper "], %[" word "], %[" in "], %[" upper "]\n\t" \
    "sxtb16 %[" word "], %[" word "], ror #8\n\t"                \
    "smlad  %[" lower "], %[" word "], %[" in "], %[" lower "]\n\t"
#define FOUR_INPUTS                                                                                        \
    "ldrd   %[x0], %[x1], [%[x]], #8\n\t"                                                                  \
    "ldrd   %[w0], %[w1], [%[w]], #8\n\t" WORD("w0", "x0", "a0", "a1") WORD("w1", "x1", "a0", "a1")        \
    "ldrd   %[w0], %[w1], [%[w]], #8\n\t" WORD("w0", "x0", "a2", "a3") WORD("w1", "x1", "a2", "a3")

static inline const weight *accumulate(struct four *s, const accumulator *biases, const weight *w, const activation *x,
                                       const activation *last) {
    accumulator a0 = biases[0], a1 = biases[1], a2 = biases[2], a3 = biases[3];
    uint32_t w0, w1, x0, x1;
    int fours = (int)(last - x) / 4;
    __asm__ volatile(
        "tst    %[fours], #1\n\t"
        "bne    2f\n" /* an odd number of fours: from the middle */
        "1:\n\t" FOUR_INPUTS "2:\n\t" FOUR_INPUTS
        "subs   %[fours], #2\n\t"
        "bgt    1b"
        : [a0] "+r"(a0), [a1] "+r"(a1), [a2] "+r"(a2), [a3] "+r"(a3), [w] "+r"(w), [x] "+r"(x), [w0] "=&r"(w0),
          [w1] "=&r"(w1), [x0] "=&r"(x0), [x1] "=&r"(x1), [fours] "+r"(fours)
        :
        : "cc", "memory");
    __asm__ volatile("sub %0, %0, %1, lsl #8\n\tsub %0, %0, %2" : "+r"(a0) : "r"(a1), "r"(s->shared));
    __asm__ volatile("sub %0, %0, %1, lsl #8\n\tsub %0, %0, %2" : "+r"(a2) : "r"(a3), "r"(s->shared));
    s->a0 = a0, s->a1 = a1, s->a2 = a2, s->a3 = a3;
    return w;
}

/* 2^7 times the sum of the activations, which u = w + 2^7 adds. */
APART accumulator sum_of(const activation *x, const activation *last) {
    accumulator sum = 0;
    uint32_t x0, x1;
    __asm__ volatile(
        "1:\n\t"
        "ldrd   %[x0], %[x1], [%[x]], #8\n\t"
        "smlad  %[sum], %[x0], %[ones], %[sum]\n\t"
        "smlad  %[sum], %[x1], %[ones], %[sum]\n\t"
        "cmp    %[x], %[last]\n\t"
        "bne    1b"
        : [sum] "+r"(sum), [x] "+r"(x), [x0] "=&r"(x0), [x1] "=&r"(x1)
        : [last] "r"(last), [ones] "r"(0x10001)
        : "cc", "memory");
    return sum << 7;
}

#elif defined(BODY_ARMV6M)

/* In a high register; with -Os GCC has none to allocate but those named. */
#ifdef __OPTIMIZE_SIZE__
#define HIGH(name, in) name __asm__(in)
#define H "r"
#else
#define HIGH(name, in) name
#define H "h"
#endif

#define MAC(word, shift, a)                    \
    "lsrs %[t], " word ", #" shift "\n\t"      \
    "muls %[t], %[in], %[t]\n\t"               \
    "add  %[" a "], %[t]\n\t"
#define COLUMN(word, in)                       \
    "ldrh %[in], [%[x], #" in "]\n\t"          \
    MAC(word, "24", "a3") MAC(word, "16", "a2") MAC(word, "8", "a1") \
    "muls " word ", %[in], " word "\n\t"       \
    "add  %[a0], " word "\n\t"

static inline const weight *accumulate(struct four *s, const accumulator *biases, const weight *w, const activation *x,
                                       const activation *last) {
    accumulator a0 = biases[0];
    register accumulator HIGH(a1, "r8");
    register accumulator a2 __asm__("r12");
    register accumulator a3 __asm__("r14");
    register uint32_t w0 __asm__("r4");
    register uint32_t w1 __asm__("r5");
    register const activation *HIGH(end, "r10");
    uint32_t in, t;
    a1 = biases[1], a2 = biases[2], a3 = biases[3], end = last;
    __asm__ volatile(
        ".syntax unified\n"
        "1:\n\t"
        "ldmia %[w]!, {r4, r5}\n\t" COLUMN("r4", "0") COLUMN("r5", "2")
        "ldmia %[w]!, {r4, r5}\n\t" COLUMN("r4", "4") COLUMN("r5", "6")
        "adds %[x], %[x], #8\n\t"
        "cmp  %[x], %[last]\n\t"
        "bne  1b"
        : [a0] "+l"(a0), [a1] "+" H(a1), [a2] "+r"(a2), [a3] "+r"(a3), [w] "+l"(w), [x] "+l"(x), [in] "=&l"(in),
          [t] "=&l"(t), "=&l"(w0), "=&l"(w1)
        : [last] H(end)
        : "cc", "memory");
    s->a0 = a0, s->a1 = a1, s->a2 = a2, s->a3 = a3;
    return w;
}

/* 2^7 times the sum of the activations, which u = w + 2^7 adds. */
APART accumulator sum_of(const activation *x, const activation *last) {
    accumulator sum = 0;
    for (; x != last; x += 4) {
        sum += (accumulator)x[0] + x[1] + x[2] + x[3];
    }
    return sum << 7;
}

#else

static inline const weight *accumulate(struct four *s, const accumulator *biases, const weight *w, const activation *x,
                                       const activation *last) {
    int32_t a0 = biases[0], a1 = biases[1], a2 = biases[2], a3 = biases[3];
    for (; x != last; x += 4, w += 16) {
        int32_t in = x[0];
        a0 += w[0] * in, a1 += w[4] * in, a2 += w[8] * in, a3 += w[12] * in;
        in = x[1];
        a0 += w[1] * in, a1 += w[5] * in, a2 += w[9] * in, a3 += w[13] * in;
        in = x[2];
        a0 += w[2] * in, a1 += w[6] * in, a2 += w[10] * in, a3 += w[14] * in;
        in = x[3];
        a0 += w[3] * in, a1 += w[7] * in, a2 += w[11] * in, a3 += w[15] * in;
    }
    s->a0 = a0, s->a1 = a1, s->a2 = a2, s->a3 = a3;
    return w;
}

#endif
#endif

#if defined(BODY_MVE) || !(defined(BODY_DSP) || defined(BODY_ARMV6M))

/* Weights as they are need no sum. */
static inline accumulator sum_of(const activation *x, const activation *last) {
    (void)x, (void)last;
    return 0;
}

#endif

#if !(defined(BODY_MVE) || defined(BODY_ARMV6M))

/* Saturated to 16 bits, with `relu` to [0, 32767]. */
static inline int32_t saturated(int32_t z, int relu) {
#ifdef SATURATE
    if (relu) {
        __asm__("usat %0, #15, %1" : "=r"(z) : "r"(z));
    } else {
        __asm__("ssat %0, #16, %1" : "=r"(z) : "r"(z));
    }
    return z;
#else
    const int32_t least = relu ? 0 : -32768;
    return z > 32767 ? 32767 : z < least ? least : z;
#endif
}

#endif

#if TANH || UNITS

/* 2^15 plus tanh of z * 6 / 2^15, interpolated linearly in a table with an entry every 2^8; of z + OFFSET. */
static inline int32_t tanh_of(int32_t z) {
    const uint16_t *const at = tanh_table + (OFFSET ? 0 : 128) + (z >> 8);
    const int32_t low = at[0];
    return low + (((at[1] - low) * (z & 255) + 128) >> 8);
}

#endif

#if INTEGRAL || !(defined(BODY_DSP) || defined(BODY_MVE) || defined(BODY_ARMV6M))

/* floor(x * factor / 2^16) */
static inline int32_t scaled(int32_t x, uint32_t factor) {
#ifdef BODY_ARMV6M /* by halves: there is no 64-bit product */
    return (x >> 16) * (int32_t)factor + (int32_t)((uint16_t)x * factor >> 16);
#else
    return (int32_t)(((int64_t)x * (int32_t)(factor << 16)) >> 32);
#endif
}

#endif

/* Four outputs from their sums; `hidden` layers have an activation. */
#if defined(BODY_MVE)

static inline void four_outputs(activation *y, const struct four *s, const struct outputs *o, int shift, int hidden) {
    const int32x4_t upper = vshlq_n_s32(vreinterpretq_s32_u32(vldrhq_u32(o->factors)), 16);
    const int32x4_t z = vshlq_r_s32(vmulhq_s32(s->sums, upper), -shift);
    const int16x8_t within = vqmovnbq_s32(vdupq_n_s16(0), z); /* in the lower halves of four words */
#if TANH
    if (hidden) { /* as tanh_of */
        const uint32x4_t u = veorq_u32(vreinterpretq_u32_s16(within), vdupq_n_u32(32768)), at = vshrq_n_u32(u, 8);
        const uint32x4_t low = vldrhq_gather_shifted_offset_u32(tanh_table, at);
        const uint32x4_t rise = vsubq_u32(vldrhq_gather_shifted_offset_u32(tanh_table + 1, at), low);
        const uint32x4_t more = vrshrq_n_u32(vmulq_u32(rise, vandq_u32(u, vdupq_n_u32(255))), 8);
        vstrhq_u32((uint16_t *)y, vsubq_u32(vaddq_u32(low, more), vdupq_n_u32(32768)));
        return;
    }
#endif
    vstrhq_s32(y, vreinterpretq_s32_s16(vmaxq_s16(within, vdupq_n_s16(hidden ? 0 : -32768))));
}

#elif defined(BODY_DSP)

/* Two factors, and two outputs, in a word. */
static inline uint32_t two_outputs(accumulator acc0, accumulator acc1, uint32_t factor, int shift, int relu) {
    int32_t z0, z1;
    uint32_t word;
    __asm__("smulwb %0, %1, %2" : "=r"(z0) : "r"(acc0), "r"(factor));
    __asm__("smulwt %0, %1, %2" : "=r"(z1) : "r"(acc1), "r"(factor));
    z0 = saturated(z0 >> shift, relu);
    z1 = saturated(z1 >> shift, relu);
    __asm__("pkhbt %0, %1, %2, lsl #16" : "=r"(word) : "r"(z0), "r"(z1));
    return word;
}

static inline void four_outputs(activation *y, const struct four *s, const struct outputs *o, int shift, int hidden) {
    const uint32_t first = two_outputs(s->a0, s->a1, o->factors[0], shift, hidden && !TANH);
    const uint32_t second = two_outputs(s->a2, s->a3, o->factors[1], shift, hidden && !TANH);
    __asm__ volatile("strd %0, %1, [%2]" : : "r"(first), "r"(second), "r"(y) : "memory");
}

#elif defined(BODY_ARMV6M)

/* floor(a0 * factor / 2^16) by halves, as there is no 64-bit product; what is saturated is rare. */
#define OUTPUT(at, factor)                                                                            \
    "ldrh %[u], [%[o], #" factor "]\n\t" /* after the biases */                                         \
    "asrs %[t], %[a0], #16\n\t"                                                                       \
    "muls %[t], %[u], %[t]\n\t"                                                                       \
    "uxth %[a0], %[a0]\n\t"                                                                           \
    "muls %[a0], %[u], %[a0]\n\t"                                                                     \
    "lsrs %[a0], %[a0], #16\n\t"                                                                      \
    "adds %[a0], %[a0], %[t]\n\t"                                                                     \
    "asrs %[a0], %[a0], %[shift]\n\t"                                                                 \
    "add  %[a0], %[offset]\n\t"                                                                       \
    "lsrs %[t], %[a0], #16\n\t"                                                                       \
    "beq  1f\n\t"                                                                                     \
    "asrs %[a0], %[a0], #31\n\t"                                                                      \
    "mvns %[a0], %[a0]\n"                                                                              \
    "1:\n\t"                                                                                          \
    "strh %[a0], [%[y], #" at "]\n\t"
#define NEXT(a) "mov  %[a0], %[" a "]\n\t"
#define WITHOUT(above)                                                                                \
    "mov  %[t], %[" above "]\n\t"                                                                     \
    "lsls %[t], %[t], #8\n\t"                                                                         \
    "subs %[a0], %[a0], %[t]\n\t"
#define SHARED "subs %[a0], %[a0], %[shared]\n\t"

static inline void four_outputs(activation *y, const struct four *s, const struct outputs *o, int shift, int hidden) {
    accumulator a0 = s->a0;
    register accumulator HIGH(a1, "r8");
    register accumulator a2 __asm__("r12");
    register accumulator a3 __asm__("r14");
    register uint32_t HIGH(offset, "r11");
    uint32_t t, u;
    a1 = s->a1, a2 = s->a2, a3 = s->a3, offset = OFFSET;
    __asm__ volatile(
        ".syntax unified\n"
        WITHOUT("a1") SHARED OUTPUT("0", "16") NEXT("a1") WITHOUT("a2") SHARED OUTPUT("2", "18")
        NEXT("a2") WITHOUT("a3") SHARED OUTPUT("4", "20") NEXT("a3") SHARED OUTPUT("6", "22")
        : [a0] "+l"(a0), [t] "=&l"(t), [u] "=&l"(u)
        : [a1] H(a1), [a2] "r"(a2), [a3] "r"(a3), [o] "l"(o), [y] "l"(y), [shift] "l"(shift),
          [shared] "l"(s->shared), [offset] H(offset)
        : "cc", "memory");
    typedef uint32_t __attribute__((may_alias)) pair;
    for (pair *two = (void *)y; hidden && !TANH && two != (pair *)(void *)(y + 4); ++two) { /* below OFFSET: OFFSET */
        const uint32_t positive = *two >> 15 & 0x00010001u;
        *two = (*two & ((positive << 15) - positive)) | 0x80008000u;
    }
}

#else

static inline activation output(accumulator acc, uint32_t factor, int shift, int hidden) {
    const int32_t z = saturated(scaled(acc, factor) >> shift, hidden && !TANH);
#if TANH
    return (activation)(hidden ? tanh_of(z) - 32768 : z);
#else
    return (activation)z;
#endif
}

static inline void four_outputs(activation *y, const struct four *s, const struct outputs *o, int shift, int hidden) {
    y[0] = output(s->a0, o->factors[0], shift, hidden);
    y[1] = output(s->a1, o->factors[1], shift, hidden);
    y[2] = output(s->a2, o->factors[2], shift, hidden);
    y[3] = output(s->a3, o->factors[3], shift, hidden);
}

#endif

/* One layer, four outputs at a time; x, whose sum is `shared`, and y are aligned to pairs. */
APART void dense(const struct layer *l, const activation *x, accumulator shared, activation *y) {
    const activation *const last = x + l->inputs;
    const weight *w = l->weights;
    const int shift = l->shift, hidden = l->hidden;
    for (const struct outputs *o = l->outputs, *const end = l->end; o != end; ++o, y += 4) {
        struct four s = {.shared = shared};
        w = accumulate(&s, o->biases, w, x, last);
#ifdef SATURATE /* by other instructions */
        if (hidden) {
            four_outputs(y, &s, o, shift, 1);
        } else {
            four_outputs(y, &s, o, shift, 0);
        }
#else
        four_outputs(y, &s, o, shift, hidden);
#endif
#if TANH && (defined(BODY_DSP) || defined(BODY_ARMV6M))
        for (int i = 0; hidden && i < 4; ++i) {
            y[i] = (activation)(tanh_of(y[i]) - 32768 + OFFSET);
        }
#endif
    }
}

#if MEMORY || TURN

static inline int32_t limited(int32_t x, int32_t least, int32_t most) {
    return x < least ? least : x > most ? most : x;
}

/* x / 2^shift, rounded; half is rounded up. */
static inline int32_t shifted(int32_t x, int shift) {
    return (x + ((int32_t)1 << shift >> 1)) >> shift;
}

#endif

#if UNITS

/* A sigmoid in 1 / 2^15: (1 + tanh of half of its argument) / 2, of the half. */
static inline int32_t sigmoid(activation z) {
    return tanh_of(z) >> 1;
}

/* A gated recurrent unit of three layers: the gates of the inputs x in `a` and of its own numbers, g; i of x, and m of g. The
   next numbers h take the place of x. r, z = sigmoid(gates), n = tanh(i + r * m), h = n + (h - n) * z */
#ifdef BODY_ARMV6M /* which has few registers */
APART
#else
static
#endif
void remember(const struct layer *l, activation *a, activation *y, int16_t h[UNITS]) {
    activation *const g = a + MEMORY_AT;
    const activation *const i = y + INPUT_AT, *const m = i + PADDED_UNITS;
    for (int k = 0; k < PADDED_UNITS; ++k) {
        g[k] = (activation)((k < UNITS ? shifted(h[k], MEMORY_SHIFT) : 0) + OFFSET);
    }
    const accumulator of_x = sum_of(a, a + l[1].inputs), of_g = sum_of(g, g + PADDED_UNITS);
    dense(l, a, of_x + of_g, y);
    dense(l + 1, a, of_x, y + INPUT_AT);
    dense(l + 2, g, of_g, y + INPUT_AT + PADDED_UNITS);
    for (int k = 0; k < UNITS; ++k) {
        const int32_t r = sigmoid(y[k]), z = sigmoid(y[k + UNITS]);
        const int32_t more = shifted(r * (int32_t)m[k], 15) - (OFFSET ? r : 0); /* r * m, m without its offset */
        int32_t sum = ((int32_t)i[k] + more) * (1 << CANDIDATE_SHIFT) + OFFSET - OFFSET * (1 << CANDIDATE_SHIFT);
        if (((uint32_t)sum + 32768u - OFFSET) >> 16) { /* rarely */
            sum = (sum < 0 ? -32768 : 32767) + OFFSET;
        }
        const int32_t n = tanh_of(sum) - 32768;
        const int32_t next = n + shifted((h[k] - n) * z, 15);
        h[k] = (int16_t)next;
        a[k] = (activation)(next + OFFSET);
    }
}

#endif

/* The outputs of the last layer, for quantized inputs in `a`, padded with zeros. */
static const activation *network(union activations *a, union activations *b, @name@_state *state) {
    for (const struct layer *l = layers; l != layers + LAYERS; ++l) {
#if UNITS
        if (l == layers + UNIT_LAYER) {
            remember(l, a->one, b->one, state->recurrent);
            l += 3;
        }
#endif
        dense(l, a->one, sum_of(a->one, a->one + l->inputs), b->one);
        union activations *const swapped = a;
        a = b;
        b = swapped;
    }
    (void)state;
    return a->one;
}

/* Store one input, saturated, which is rare; returns 1 if saturation changed it. */
static inline int put(activation *x, const struct input *in, int32_t q) {
    const int32_t least = in->least;
    if ((uint32_t)(q - least) > in->span) {
        *x = (activation)((q < least ? least : least + in->span) + OFFSET);
        return 1;
    }
    *x = (activation)(q + OFFSET);
    return 0;
}

#if INTEGRAL

#ifdef CIRCLE
#define GATING 2
/* A coordinate over the diameter of the circle, in 1 / 2^15. */
static int32_t over(int32_t p, const struct factor *d) {
    return limited(shifted(p * d->factor, d->shift), -32767, 32767);
}
#else
#define GATING INTEGRAL
#endif

/* integral += period * e * max(0, 1 - |e|^2 / radius^2)^2, within its limits. The error e is the position among the
   inputs; on a circle of radius c it is o = (x^2 + y^2 - c^2) / (2 c), z, o x / c and o y / c, with o and z in |e|. */
static void integrate(int32_t integral[INTEGRAL], union activations *x) {
    int32_t e[POSITIONS > INTEGRAL ? POSITIONS : INTEGRAL], inside = (int32_t)1 << 30; /* 1 - |e|^2 / radius^2, in 1 / 2^30 */
    for (int i = 0; i < POSITIONS; ++i) {
        e[i] = (int32_t)x->one[positions[i].input] - OFFSET;
        x->one[positions[i].input] = (activation)(shifted(e[i], positions[i].shift) + OFFSET);
    }
#ifdef CIRCLE
    const int32_t x_of = over(e[0], diameter), y_of = over(e[1], diameter + 1);
    e[0] = shifted(x_of * x_of - ((int32_t)1 << 28) + y_of * y_of, 15);
    e[1] = e[2];
    e[2] = limited(shifted(e[0] * x_of, 14), -57344, 57344);
    e[3] = limited(shifted(e[0] * y_of, 14), -57344, 57344);
#endif
    for (int i = 0; i < GATING; ++i) {
        const int32_t v = shifted(e[i] * errors[i].inverse_radius, errors[i].inverse_radius_shift);
        inside -= v >= 32768 || v <= -32768 ? (int32_t)1 << 30 : v * v;
    }
    inside = inside > 0 ? inside >> 15 : 0;
    const int32_t gate = inside * inside >> 15; /* 2^15: open */
    for (int i = 0; i < INTEGRAL; ++i) {
        const int32_t more = shifted(scaled(e[i] * gate, errors[i].gain), errors[i].gain_shift);
        integral[i] = limited(integral[i] + more, -INTEGRAL_LIMIT, INTEGRAL_LIMIT);
    }
}

#endif

#if TURN

/* A vector of the world in the body frame, of three numbers or, if it is horizontal, of two. */
static void rotated(activation y[3], const int32_t r[9], const activation v[], int numbers, int shift) {
    const int32_t v0 = (int32_t)v[0] - OFFSET, v1 = (int32_t)v[1] - OFFSET, v2 = numbers > 2 ? (int32_t)v[2] - OFFSET : 0;
    const int32_t half = (int32_t)1 << shift >> 1;
    for (int j = 0; j < 3; ++j) {
        const int32_t sum = (r[j] * v0 >> 1) + (r[3 + j] * v1 >> 1) + (r[6 + j] * v2 >> 1);
        y[j] = (activation)(limited((sum + half) >> shift, -32767, 32767) + OFFSET);
    }
}

/* The observation as it is in the body frame: of the rotation matrix the first row, if the heading matters, and the
   third; position, velocity, body rates, and the vectors that follow. */
static void turn(union activations *x, int32_t r[9]) {
    activation *to = x->one;
    for (int i = 0; i < 9; ++i) {
        r[i] = (int32_t)x->one[i] - OFFSET;
    }
#if HEADING
    for (int i = 0; i < 3; ++i) {
        *to++ = (activation)(shifted(r[i], UP_SHIFT) + OFFSET);
    }
#endif
    for (int i = 6; i < 9; ++i) {
        *to++ = (activation)(shifted(r[i], UP_SHIFT) + OFFSET);
    }
    rotated(to, r, x->one + 9, 3, POSITION_SHIFT);
    rotated(to + 3, r, x->one + 12, 3, VELOCITY_SHIFT);
    for (int i = 0; i < 3; ++i) {
        to[6 + i] = x->one[15 + i];
    }
#if VECTORS
    for (int i = 0; i < 3 * VECTORS; i += 3) {
        rotated(to + 9 + i, r, x->one + 18 + i, 3, AHEAD_SHIFT);
    }
#endif
}

#endif

/* The inputs after the observation, which is complete: those of the state, and zeros up to a multiple of 4. */
static void complete(union activations *x, @name@_state *state) {
#if INTEGRAL
    integrate(state->integral, x);
#endif
#if TURN
    int32_t r[9];
    turn(x, r);
#endif
#if KEPT
    int i = SEEN;
    for (const struct kept *k = kept; k != kept + KEPT; ++i, ++k) {
        const int at = i - SEEN;
#if PREVIOUS_ACTION && INTEGRAL
        const int32_t value = at < @NAME@_ACT_SIZE ? state->previous_action[at] : state->integral[at - @NAME@_ACT_SIZE];
#elif PREVIOUS_ACTION
        const int32_t value = state->previous_action[at];
#else
        const int32_t value = state->integral[at];
#endif
        x->one[i] = (activation)(limited(shifted(value, k->shift), k->least, k->most) + OFFSET);
    }
#if TURN && LAST /* the last are a vector, of two numbers if it is horizontal */
    activation last[LAST];
    for (int k = 0; k < LAST; ++k) {
        last[k] = x->one[i - LAST + k];
    }
    rotated(x->one + i - LAST, r, last, LAST, 15);
#endif
#else
    (void)state;
#endif
    for (int k = INPUTS; k < PADDED_INPUTS; ++k) {
        x->one[k] = (activation)OFFSET;
    }
}

/* Round x / lsb to an integer, x given by the bits of a finite float and their exponent; a result beyond 32767 is inexact,
   but beyond 32767. In integers only: independent of compiler flags, and without a floating-point library. */
static inline int32_t quantised(uint32_t bits, int32_t exponent, const struct input *in) {
    const int32_t shift = in->exponent - exponent;
    if (shift > 31) {
        return 0; /* below half an lsb */
    }
    const uint32_t product = ((bits & 0x7fffffu) | 0x800000u) / 256u * in->scale; /* at least 2^30 */
    const int32_t size = (int32_t)(((product >> (shift < 14 ? 14 : shift)) + 1u) / 2u);
    return bits >> 31 ? -size : size;
}

void @name@_reset(@name@_state *state) {
#if INTEGRAL
    for (int i = 0; i < INTEGRAL; ++i) {
        state->integral[i] = 0;
    }
#endif
#if PREVIOUS_ACTION
    for (int i = 0; i < @NAME@_ACT_SIZE; ++i) {
        state->previous_action[i] = act_first[i];
    }
#endif
#if UNITS
    for (int i = 0; i < UNITS; ++i) {
        state->recurrent[i] = 0;
    }
#endif
#if !MEMORY
    state->unused = 0;
#endif
}

/* A step in SI units, of float, or with `fixed` in steps of the lsb, of int16_t. */
static int stepped(@name@_state *state, const void *obs, void *act, int fixed) {
    union activations a, b;
    int status = 0;
    for (int i = 0; fixed && i < @NAME@_OBS_SIZE; ++i) {
        status |= put(a.one + i, inputs + i, ((const int16_t *)obs)[i]);
    }
    for (int i = 0; !fixed && i < @NAME@_OBS_SIZE; ++i) {
        const union {
            float real;
            uint32_t bits;
        } in = {((const float *)obs)[i]};
        const int32_t exponent = in.bits >> 23 & 255;
        if (exponent == 255) { /* infinite or not a number, by its bits: -ffast-math assumes that no float is NaN */
            for (int j = 0; j < @NAME@_ACT_SIZE; ++j) {
                ((float *)act)[j] = act_safe[j];
            }
            return 2;
        }
        status |= put(a.one + i, inputs + i, quantised(in.bits, exponent, inputs + i));
    }
    complete(&a, state);
    const activation *const y = network(&a, &b, state);
    for (int i = 0; i < @NAME@_ACT_SIZE; ++i) {
        const int32_t z = (int32_t)y[i] - OFFSET, least = act_least[i], most = act_most[i];
        const int16_t steps = (int16_t)(z < least ? least : z > most ? most : z);
#if PREVIOUS_ACTION
        state->previous_action[i] = steps;
#endif
        if (fixed) {
            ((int16_t *)act)[i] = steps;
        } else {
            ((float *)act)[i] = (float)steps * act_lsb[i];
        }
    }
    return status;
}

int @name@_step(@name@_state *state, const float obs[@NAME@_OBS_SIZE], float act[@NAME@_ACT_SIZE]) {
    return stepped(state, obs, act, 0);
}

int @name@_step_i16(@name@_state *state, const int16_t obs[@NAME@_OBS_SIZE], int16_t act[@NAME@_ACT_SIZE]) {
    return stepped(state, obs, act, 1);
}

#if MEMORY

/* Whether the state is not the one after the last golden vector. */
static int differs(const @name@_state *state) {
    const unsigned char *const found = (const void *)state, *const wanted = (const void *)&golden_state;
    int wrong = 0;
    for (int i = 0; i < STATE_BYTES; ++i) {
        wrong |= found[i] ^ wanted[i];
    }
    return wrong;
}

#endif

int @name@_selftest(void) {
    union {
        float real[@NAME@_ACT_SIZE];
        int16_t steps[@NAME@_ACT_SIZE];
    } act;
    @name@_state state, state_i16;
    @name@_reset(&state);
    @name@_reset(&state_i16);
    for (int k = 0; k < GOLDENS; ++k) {
        int wrong = @name@_step(&state, goldens.vectors[k].obs, act.real) != goldens.vectors[k].status;
        for (int i = 0; i < @NAME@_ACT_SIZE; ++i) {
            const volatile float wanted = (float)goldens.vectors[k].act[i] * act_lsb[i]; /* rounded to float, also on x87 */
            wrong |= !(act.real[i] == wanted);
        }
        wrong |= @name@_step_i16(&state_i16, goldens.vectors[k].obs_i16, act.steps) != goldens.vectors[k].status_i16;
        for (int i = 0; i < @NAME@_ACT_SIZE; ++i) {
            wrong |= act.steps[i] != goldens.vectors[k].act[i];
        }
        if (wrong) {
            return k + 1;
        }
    }
    int wrong = @name@_step(&state, (const void *)&goldens, act.real) != 2; /* begins with no number */
    for (int i = 0; i < @NAME@_ACT_SIZE; ++i) {
        wrong |= !(act.real[i] == act_safe[i]);
    }
#if MEMORY
    wrong |= differs(&state) || differs(&state_i16); /* after the last vector: no number changes nothing */
#endif
    return wrong ? GOLDENS + 1 : 0;
}
