/* A flight through the board's duty, twice: vector triads first, then the gyroscope. The same program on the host and on
   an emulated Cortex-M4F, whose files and output are the host's by semihosting. flight.bin → what it prints, dump.bin. */
#include <stdio.h>
#include <string.h>

#include "fieldcal_onboard.h"

typedef struct {
    uint32_t t_us;
    uint32_t has_field;
    float gyroscope[3];
    float accelerometer[3];
    float magnetometer[3];
} sample;

static fieldcal_board board;
static fieldcal_board loaded;
static fieldcal_result result;

#if defined(__arm__)
#define SYSTICK ((volatile uint32_t *)0xE000E010u)
/* At 25 MHz; with `-icount shift=0` an instruction is a nanosecond, a tick 40 of them. */
static void start_ticks(void)
{
    SYSTICK[1] = 0x00FFFFFFu;
    SYSTICK[2] = 0u;
    SYSTICK[0] = 5u;
    while (SYSTICK[2] == 0u) {
    }
}
static uint32_t ticks(void)
{
    return 0x00FFFFFFu - SYSTICK[2];
}
#else
static void start_ticks(void)
{
}
static uint32_t ticks(void)
{
    return 0u;
}
#endif

static void tell(const char *name, const float *values, int n)
{
    printf("%s", name);
    for (int i = 0; i < n; i++) {
        printf(" %.9g", (double)values[i]);
    }
    printf("\n");
}

static void tell_ellipsoid(const char *name, const fieldcal_ellipsoid *fit)
{
    printf("%s.code %d\n", name, (int)fit->code);
    printf("%s", name);
    tell(".scale", &fit->scale[0][0], 9);
    printf("%s", name);
    tell(".scale_sd", &fit->scale_sd[0][0], 9);
    printf("%s", name);
    tell(".bias", fit->bias, 3);
    printf("%s", name);
    tell(".bias_sd", fit->bias_sd, 3);
    printf("%s", name);
    tell(".covariance", &fit->covariance[0][0], 36);
    printf("%s", name);
    const float numbers[3] = {fit->condition, fit->residual_rms, fit->excess};
    tell(".numbers", numbers, 3);
    printf("%s", name);
    tell(".noise_sd", fit->noise_sd, 3);
}

static void tell_gyroscope(const fieldcal_gyroscope_fit *fit)
{
    printf("gyroscope.code %d %d %d\n", (int)fit->code[0], (int)fit->code[1], (int)fit->code[2]);
    tell("gyroscope.scale", fit->scale, 3);
    tell("gyroscope.scale_sd", fit->scale_sd, 3);
    tell("gyroscope.bias", fit->bias, 3);
    tell("gyroscope.bias_sd", fit->bias_sd, 3);
    tell("gyroscope.covariance", fit->covariance, 3);
    tell("gyroscope.residual_rms", fit->residual_rms, 3);
    tell("gyroscope.correlation", fit->correlation, 3);
}

static uint32_t fly(int *left_out)
{
    static sample block[256];
    uint32_t spent = 0u;
    FILE *file = fopen("flight.bin", "rb");
    if (file == NULL) {
        return 0u;
    }
    for (size_t n = fread(block, sizeof(sample), 256u, file); n > 0u; n = fread(block, sizeof(sample), 256u, file)) {
        start_ticks();
        const uint32_t before = ticks();
        for (size_t k = 0; k < n; k++) {
            const sample *s = &block[k];
            const float *field = (s->has_field != 0u) ? s->magnetometer : NULL;
            *left_out += (fieldcal_feed(&board, s->t_us, s->gyroscope, s->accelerometer, field) == FIELDCAL_OK) ? 0 : 1;
        }
        spent += ticks() - before;
    }
    (void)fclose(file);
    return spent;
}

/* Dumps of the board, and the board that they make again. */
static int dump(void)
{
    static uint8_t bytes[3 * FIELDCAL_DUMP_BYTES(34)];
    size_t at = 0u;
    at += fieldcal_moments_dump(&board.magnetometer, FIELDCAL_MAGNETOMETER, &bytes[at], sizeof(bytes) - at);
    at += fieldcal_moments_dump(&board.accelerometer, FIELDCAL_ACCELEROMETER, &bytes[at], sizeof(bytes) - at);
    at += fieldcal_rates_dump(&board.gyroscope, &bytes[at], sizeof(bytes) - at);
    FILE *file = fopen("dump.bin", "wb");
    if (file == NULL) {
        return 1;
    }
    const size_t written = fwrite(bytes, 1u, at, file);
    (void)fclose(file);
    const size_t one = FIELDCAL_DUMP_BYTES(FIELDCAL_SUMS);
    fieldcal_start(&loaded);
    int wrong = (written == at) ? 0 : 1;
    wrong += (int)fieldcal_moments_load(&loaded.magnetometer, FIELDCAL_MAGNETOMETER, bytes, at);
    wrong += (int)fieldcal_moments_load(&loaded.accelerometer, FIELDCAL_ACCELEROMETER, &bytes[one], at - one);
    wrong += (int)fieldcal_rates_load(&loaded.gyroscope, &bytes[2u * one], at - (2u * one));
    wrong += (fieldcal_moments_load(&loaded.magnetometer, FIELDCAL_ACCELEROMETER, bytes, at) == FIELDCAL_BAD_DUMP) ? 0 : 1;
    bytes[40] ^= 1u;
    wrong += (fieldcal_moments_load(&loaded.magnetometer, FIELDCAL_MAGNETOMETER, bytes, at) == FIELDCAL_BAD_DUMP) ? 0 : 1;
    bytes[40] ^= 1u;
    return wrong;
}

int main(void)
{
    int left_out = 0;
    fieldcal_start(&board);
    const uint32_t vectors = fly(&left_out);
    start_ticks();
    const uint32_t before = ticks();
    fieldcal_solve(&board, &result);
    const uint32_t solved = ticks() - before;
    const uint32_t fed = board.accelerometer.samples;
    const uint32_t all = fly(&left_out);
    fieldcal_solve(&board, &result);
    tell_ellipsoid("magnetometer", &result.magnetometer);
    tell_ellipsoid("accelerometer", &result.accelerometer);
    tell_gyroscope(&result.gyroscope);
    printf("left_out %d\n", left_out);
    printf("dump %d\n", dump());
    /* Both halves merged are the whole, whatever their centres. */
    fieldcal_moments merged;
    const float elsewhere[3] = {board.magnetometer.centre[0] + 1000.0f, board.magnetometer.centre[1] - 300.0f, 7.0f};
    fieldcal_moments_start(&merged, 1u, elsewhere);
    (void)fieldcal_moments_merge(&merged, &board.magnetometer);
    const fieldcal_limits limits = {1.0f, {1.0f, 1.0f, 1.0f}, false, 1.0f, 1.0e6f, 1.0e6f, 1.0e6f};
    (void)fieldcal_moments_solve(&merged, &limits, &result.magnetometer);
    tell_ellipsoid("merged", &result.magnetometer);
    printf("ticks %lu %lu %lu %lu\n", (unsigned long)fed, (unsigned long)vectors, (unsigned long)all,
           (unsigned long)solved);
    printf("bytes %lu %lu %lu\n", (unsigned long)sizeof(fieldcal_moments), (unsigned long)sizeof(fieldcal_rates),
           (unsigned long)sizeof(fieldcal_board));
    return 0;
}
