/* Attitudes of pairs of vectors: vectors.bin → QUEST, TRIAD and Eq. 2 and 4, a line each. */
#include <stdio.h>

#include "fieldcal_onboard.h"

static void tell(const char *name, fieldcal_code code, const float q[4])
{
    printf("%s %d %.9g %.9g %.9g %.9g\n", name, (int)code, (double)q[0], (double)q[1], (double)q[2], (double)q[3]);
}

int main(void)
{
    float pair[14]; /* b (2, 3), r (2, 3), sigma (2) */
    int k = 0;
    FILE *file = fopen("vectors.bin", "rb");
    if (file == NULL) {
        return 1;
    }
    while (fread(pair, sizeof(pair), 1u, file) == 1u) {
        for (int method = 0; method < 3; method++) {
            char name[32];
            float b[2][3];
            float r[2][3];
            float q[4] = {0.0f, 0.0f, 0.0f, 0.0f};
            for (int i = 0; i < 3; i++) {
                b[0][i] = pair[i];
                b[1][i] = pair[3 + i];
                r[0][i] = pair[6 + i];
                r[1][i] = pair[9 + i];
            }
            (void)snprintf(name, sizeof(name), "%s.%d", (method == 0) ? "quest" : ((method == 1) ? "triad" : "euler"), k);
            if (method == 0) {
                tell(name, fieldcal_attitude_quest(b, r, &pair[12], q), q);
            } else if (method == 1) {
                tell(name, fieldcal_attitude_triad(b, r, q), q);
            } else {
                tell(name, fieldcal_attitude_euler(b[0], b[1], 0.25f, q), q);
            }
        }
        k++;
    }
    (void)fclose(file);
    return 0;
}
