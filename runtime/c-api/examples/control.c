#include "control.h"

/* The caller owns all memory. 2048 words of scratch are more than any shipped policy needs; `gadm inspect` tells. */
static gadm_policy policy;
static gadm_spec spec;
static uint32_t scratch[2048];
static float action[GADM_MAX_ACTIONS];

static void put_text(const char *text) {
    while (*text != '\0') {
        board_put(*text++);
    }
}

static void put_hex(uint32_t value) {
    board_put(' ');
    for (int shift = 28; shift >= 0; shift -= 4) {
        board_put("0123456789abcdef"[(value >> shift) & 15u]);
    }
}

static uint32_t bits_of(float value) {
    union {
        float number;
        uint32_t bits;
    } view;
    view.number = value;
    return view.bits;
}

static void put_refusal(const char *what, const gadm_error *error) {
    put_text(what);
    put_text(": ");
    put_text(gadm_status_text(error->status));
    put_text("\nrefused");
    put_hex((uint32_t)error->status);
    put_hex(error->index);
    put_hex((uint32_t)error->expected);
    put_hex((uint32_t)error->found);
    board_put('\n');
}

gadm_status control_start(const uint8_t *image, size_t len) {
    gadm_error error;
    gadm_status status = gadm_load(&policy, image, len, &error);
    if (status != GADM_STATUS_OK) {
        put_refusal("load", &error);
        return status;
    }
    if (gadm_scratch_words(&policy) > sizeof scratch / sizeof scratch[0]) {
        put_text("this policy needs more scratch memory than this program has\n");
        return GADM_STATUS_SCRATCH_LENGTH;
    }
    status = gadm_self_test(&policy, scratch, sizeof scratch / sizeof scratch[0], &error);
    if (status != GADM_STATUS_OK) {
        put_refusal("self-test", &error);
        gadm_unload(&policy);
        return status;
    }
    (void)gadm_get_spec(&policy, &spec);
    put_text("policy");
    put_hex((uint32_t)(spec.interface_hash >> 32));
    put_hex((uint32_t)spec.interface_hash);
    put_hex(spec.obs_dim);
    put_hex(spec.action_dim);
    put_hex(spec.num_latents);
    put_hex(spec.scratch_words);
    board_put('\n');
    return GADM_STATUS_OK;
}

static void put_step(gadm_status status, const gadm_decision *decision, const gadm_error *error) {
    if (status != GADM_STATUS_OK) {
        put_refusal("step", error);
        return;
    }
    put_text("step");
    put_hex(decision->latent);
    put_hex((uint32_t)decision->q);
    put_hex((decision->fallback ? 2u : 0u) | (decision->clipped ? 1u : 0u));
    for (size_t word = 0; word < GADM_MASK_WORDS; word++) {
        put_hex(decision->allowed[word]);
    }
    for (size_t slot = 0; slot < spec.action_dim; slot++) {
        put_hex(bits_of(action[slot]));
    }
    board_put('\n');
}

void control_run(const float *obs, size_t steps, const int16_t *obs_q, size_t steps_q) {
    const size_t words = sizeof scratch / sizeof scratch[0];
    gadm_decision decision;
    gadm_error error;
    for (size_t step = 0; step < steps; step++) {
        const float *now = obs + step * spec.obs_dim;
        gadm_status status =
            gadm_act(&policy, now, spec.obs_dim, scratch, words, action, spec.action_dim, &decision, &error);
        put_step(status, &decision, &error);
    }
    for (size_t step = 0; step < steps_q; step++) {
        const int16_t *now = obs_q + step * spec.obs_dim;
        gadm_status status =
            gadm_act_q(&policy, now, spec.obs_dim, scratch, words, action, spec.action_dim, &decision, &error);
        put_step(status, &decision, &error);
    }
    put_text("end\n");
}
