// The policy in an Arduino sketch: self-test at boot, then a step every control period.
#include <qrl_policy.h>

float obs[QRL_POLICY_OBS_SIZE], act[QRL_POLICY_ACT_SIZE];
unsigned long next_us;

void setup() {
  Serial.begin(115200);
  while (qrl_policy_selftest() != 0) {
    Serial.println("self-test failed: do not fly");
    delay(1000);
  }
  next_us = micros();
}

void loop() {
  if ((long)(micros() - next_us) < 0) return;
  next_us += QRL_POLICY_PERIOD_US;

  // Yours: fill obs from the state estimate, in the order, units and frames of qrl_policy.h.
  const int status = qrl_policy_step(obs, act);
  if (status == 2) {
    // An input is not finite: act holds the safe action; hand over to a fallback controller.
  }
  // Yours: act to motor commands.
}
