/* Every function with everything that can be wrong about its arguments. Ends with the number of checks. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "gadm.h"

static int checks = 0;

static void check(int good, const char *what, int line) {
    if (!good) {
        fprintf(stderr, "line %d: %s\n", line, what);
        exit(1);
    }
    checks++;
}

#define CHECK(condition) check((condition), #condition, __LINE__)
#define GIVES(call, status) check((call) == (status), #call " gives " #status, __LINE__)

static uint8_t image[65536] __attribute__((aligned(16)));
static uint32_t scratch[4096];
static float obs[64], action[GADM_MAX_ACTIONS];
static int16_t obs_q[64];

/* A pointer that is not aligned, made from a number so that the compiler makes nothing of it. */
#define OFF(pointer, bytes) ((void *)((uintptr_t)(pointer) + (bytes)))

int main(int count, char **words) {
    FILE *file = count == 2 ? fopen(words[1], "rb") : NULL;
    if (file == NULL) {
        return 2;
    }
    const size_t len = fread(image, 1, sizeof image, file);
    (void)fclose(file);

    gadm_policy policy;
    gadm_error error;
    gadm_spec spec;
    gadm_decision decision;
    memset(&policy, 0x5A, sizeof policy);

    /* Before a load. */
    GIVES(gadm_get_spec(&policy, &spec), GADM_STATUS_NOT_LOADED);
    GIVES(gadm_self_test(&policy, scratch, 4096, &error), GADM_STATUS_NOT_LOADED);
    CHECK(error.status == GADM_STATUS_NOT_LOADED && error.section == -1);
    CHECK(gadm_scratch_words(&policy) == 0u && gadm_scratch_words(NULL) == 0u);
    GIVES(gadm_act(&policy, obs, 5, scratch, 4096, action, 3, NULL, NULL), GADM_STATUS_NOT_LOADED);

    /* Loading. */
    GIVES(gadm_load(NULL, image, len, &error), GADM_STATUS_NULL_POINTER);
    CHECK(error.status == GADM_STATUS_NULL_POINTER);
    GIVES(gadm_load(&policy, NULL, len, NULL), GADM_STATUS_NULL_POINTER);
    GIVES(gadm_load(OFF(&policy, 4), image, len, NULL), GADM_STATUS_MISALIGNED_POINTER);
    GIVES(gadm_load(&policy, image + 1, len, &error), GADM_STATUS_MISALIGNED_POINTER);
    CHECK(error.expected == 4 && error.found == 1);
    GIVES(gadm_load(&policy, image, SIZE_MAX, NULL), GADM_STATUS_BAD_LENGTH);
    GIVES(gadm_load(&policy, (const uint8_t *)&policy, sizeof policy, NULL), GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_load(&policy, image, len, OFF(&error, 1)), GADM_STATUS_MISALIGNED_POINTER);
    GIVES(gadm_load(&policy, image, 0, &error), GADM_STATUS_TRUNCATED);
    GIVES(gadm_load(&policy, image, len - 1u, &error), GADM_STATUS_TRUNCATED);
    CHECK(error.expected == (int64_t)len && error.found == (int64_t)len - 1);
    image[2] ^= 1u;
    GIVES(gadm_load(&policy, image, len, &error), GADM_STATUS_NOT_A_POLICY);
    image[2] ^= 1u;
    image[20] ^= 1u;
    GIVES(gadm_load(&policy, image, len, &error), GADM_STATUS_HEADER_CHECKSUM);
    CHECK(error.section == 0 && error.expected != error.found);
    image[20] ^= 1u;
    GIVES(gadm_load(&policy, image, len, NULL), GADM_STATUS_OK);
    image[len - 100u] ^= 1u;
    GIVES(gadm_load(&policy, image, len, NULL), GADM_STATUS_CHECKSUM);
    image[len - 100u] ^= 1u;
    /* A refused image leaves no old policy behind. */
    GIVES(gadm_get_spec(&policy, &spec), GADM_STATUS_NOT_LOADED);
    /* Behind the policy anything may follow. */
    GIVES(gadm_load(&policy, image, sizeof image, &error), GADM_STATUS_OK);
    CHECK(error.status == GADM_STATUS_OK);

    /* Asking. */
    GIVES(gadm_get_spec(&policy, NULL), GADM_STATUS_NULL_POINTER);
    GIVES(gadm_get_spec(NULL, &spec), GADM_STATUS_NULL_POINTER);
    GIVES(gadm_get_spec(&policy, OFF(&spec, 4)), GADM_STATUS_MISALIGNED_POINTER);
    GIVES(gadm_get_spec(&policy, (gadm_spec *)(void *)&policy), GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_get_spec(&policy, &spec), GADM_STATUS_OK);
    CHECK(spec.obs_dim == 5u && spec.action_dim == 3u && spec.num_latents == 7u && spec.image_len == len);
    CHECK(gadm_scratch_words(&policy) == spec.scratch_words && spec.scratch_words > 0u);
    gadm_observation_info signal;
    gadm_action_info slot;
    GIVES(gadm_observation(&policy, 4, &signal), GADM_STATUS_OK);
    CHECK(signal.name.len > 0u && signal.lo < signal.hi && signal.q_scale > 0.0f && signal.q_max > 0);
    GIVES(gadm_observation(&policy, 5, &signal), GADM_STATUS_NO_SUCH_INDEX);
    GIVES(gadm_observation(&policy, SIZE_MAX, &signal), GADM_STATUS_NO_SUCH_INDEX);
    GIVES(gadm_observation(&policy, 0, NULL), GADM_STATUS_NULL_POINTER);
    GIVES(gadm_action(&policy, 2, &slot), GADM_STATUS_OK);
    CHECK(slot.kind == GADM_ACTION_KIND_CONTINUOUS && slot.lo < slot.hi && slot.types == 0u);
    GIVES(gadm_action(&policy, 3, &slot), GADM_STATUS_NO_SUCH_INDEX);

    /* Self-test. */
    const size_t need = gadm_scratch_words(&policy);
    GIVES(gadm_self_test(&policy, scratch, need - 1u, &error), GADM_STATUS_SCRATCH_LENGTH);
    CHECK(error.expected == (int64_t)need && error.found == (int64_t)need - 1);
    GIVES(gadm_self_test(&policy, NULL, need, &error), GADM_STATUS_NULL_POINTER);
    GIVES(gadm_self_test(&policy, OFF(scratch, 2), need, &error), GADM_STATUS_MISALIGNED_POINTER);
    GIVES(gadm_self_test(&policy, (uint32_t *)(void *)&policy, 8, &error), GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_self_test(&policy, scratch, need, NULL), GADM_STATUS_OK);

    /* Steps. */
    action[0] = 123.0f;
    GIVES(gadm_act(&policy, obs, 4, scratch, need, action, 3, &decision, &error), GADM_STATUS_OBSERVATION_LENGTH);
    CHECK(error.expected == 5 && error.found == 4);
    GIVES(gadm_act(&policy, obs, 5, scratch, need, action, 2, &decision, &error), GADM_STATUS_ACTION_LENGTH);
    GIVES(gadm_act(&policy, obs, 5, scratch, need - 1u, action, 3, &decision, &error), GADM_STATUS_SCRATCH_LENGTH);
    GIVES(gadm_act(&policy, NULL, 5, scratch, need, action, 3, &decision, &error), GADM_STATUS_NULL_POINTER);
    GIVES(gadm_act(&policy, NULL, 0, scratch, need, action, 3, &decision, &error), GADM_STATUS_OBSERVATION_LENGTH);
    GIVES(gadm_act(&policy, OFF(obs, 1), 5, scratch, need, action, 3, NULL, NULL), GADM_STATUS_MISALIGNED_POINTER);
    GIVES(gadm_act(&policy, obs, SIZE_MAX, scratch, need, action, 3, NULL, NULL), GADM_STATUS_BAD_LENGTH);
    GIVES(gadm_act(&policy, obs, 5, scratch, SIZE_MAX / 4u, action, 3, NULL, NULL), GADM_STATUS_BAD_LENGTH);
    GIVES(gadm_act(&policy, obs, 5, scratch, need, obs, 5, NULL, NULL), GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_act(&policy, (float *)(void *)scratch, 5, scratch, need, action, 3, NULL, NULL),
          GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_act(&policy, obs, 5, scratch, need, action, 3, OFF(&decision, 1), NULL), GADM_STATUS_MISALIGNED_POINTER);
    GIVES(gadm_act(&policy, obs, 5, scratch, need, action, 3, (gadm_decision *)(void *)scratch, NULL),
          GADM_STATUS_OVERLAPPING_MEMORY);
    /* What a loaded policy needs is not written, not even for a report. */
    GIVES(gadm_act(&policy, obs, 5, scratch, need, action, 3, NULL, (gadm_error *)(void *)&policy.words[8]),
          GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_act(&policy, NULL, 5, scratch, need, action, 3, NULL, (gadm_error *)(void *)&policy.words[8]),
          GADM_STATUS_NULL_POINTER);
    GIVES(gadm_act(&policy, obs, 5, scratch, need, (float *)(void *)(image + 256), 3, NULL, NULL),
          GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_act(&policy, obs, 5, (uint32_t *)(void *)(image + 256), need, action, 3, NULL, NULL),
          GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_act(&policy, NULL, 5, scratch, need, action, 3, NULL, (gadm_error *)(void *)(image + 256)),
          GADM_STATUS_NULL_POINTER);
    GIVES(gadm_get_spec(&policy, (gadm_spec *)(void *)(image + 256)), GADM_STATUS_OVERLAPPING_MEMORY);
    GIVES(gadm_self_test(&policy, scratch, need, NULL), GADM_STATUS_OK);
    obs[3] = NAN;
    GIVES(gadm_act(&policy, obs, 5, scratch, need, action, 3, &decision, &error), GADM_STATUS_NON_FINITE);
    CHECK(error.index == 3u);
    CHECK(action[0] == 123.0f);
    obs[3] = 0.0f;
    GIVES(gadm_act(&policy, obs, 5, scratch, need, action, 3, &decision, NULL), GADM_STATUS_OK);
    CHECK(decision.latent < spec.num_latents && ((decision.allowed[0] >> decision.latent) & 1u) == 1u);
    CHECK(action[0] != 123.0f);
    GIVES(gadm_act_q(&policy, obs_q, 5, scratch, need, action, 3, NULL, NULL), GADM_STATUS_OK);
    GIVES(gadm_act_q(&policy, obs_q, 6, scratch, need, action, 3, NULL, NULL), GADM_STATUS_OBSERVATION_LENGTH);
    GIVES(gadm_act_q(&policy, OFF(obs_q, 1), 5, scratch, need, action, 3, NULL, NULL), GADM_STATUS_MISALIGNED_POINTER);

    /* A copy is a policy too; a forgotten one is none. */
    const gadm_policy copy = policy;
    gadm_unload(&policy);
    gadm_unload(NULL);
    GIVES(gadm_get_spec(&policy, &spec), GADM_STATUS_NOT_LOADED);
    GIVES(gadm_get_spec(&copy, &spec), GADM_STATUS_OK);

    /* Texts: one for every number, also for those that mean nothing. */
    for (int status = -2; status < 90; status++) {
        const char *text = gadm_status_text(status);
        CHECK(text != NULL && strlen(text) > 3u);
    }
    CHECK(strcmp(gadm_status_text(77), "unknown status") == 0);
    CHECK(strcmp(gadm_status_text(GADM_STATUS_SELF_TEST_OTHER), "unknown status") != 0);
    CHECK(gadm_abi_version() == 1u);
    printf("%d checks passed\n", checks);
    return 0;
}
