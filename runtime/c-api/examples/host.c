/* The example on a host: POLICY OBSERVATIONS, the second a file of u32 counts of float and of integer observations,
   then the floats, then the integers. */
#include <stdio.h>
#include <stdlib.h>

#include "control.h"

void board_put(char c) {
    putchar(c);
}

static uint8_t *read_file(const char *path, size_t *len) {
    FILE *file = fopen(path, "rb");
    if (file == NULL || fseek(file, 0, SEEK_END) != 0) {
        return NULL;
    }
    long size = ftell(file);
    rewind(file);
    /* malloc's memory suits every type, so the image is aligned. */
    uint8_t *bytes = size < 0 ? NULL : malloc((size_t)size + 1u);
    if (bytes != NULL) {
        *len = fread(bytes, 1, (size_t)size, file);
    }
    (void)fclose(file);
    return bytes;
}

int main(int count, char **words) {
    size_t image_len = 0, obs_len = 0;
    uint8_t *image = count == 3 ? read_file(words[1], &image_len) : NULL;
    uint8_t *obs = image != NULL ? read_file(words[2], &obs_len) : NULL;
    if (obs == NULL || obs_len < 8u) {
        fputs("usage: host POLICY OBSERVATIONS\n", stderr);
        return 2;
    }
    int exit_code = 1;
    if (control_start(image, image_len) == GADM_STATUS_OK) {
        const uint32_t *head = (const uint32_t *)(const void *)obs;
        const float *floats = (const float *)(const void *)(head + 3);
        control_run(floats, head[0], (const int16_t *)(const void *)(floats + (size_t)head[0] * head[2]), head[1]);
        exit_code = 0;
    }
    free(image);
    free(obs);
    return exit_code;
}
