// The policy in an Arduino sketch: self-test at boot, then a step every control period.
#include <@name@.h>

@name@_state state;
float obs[@NAME@_OBS_SIZE], act[@NAME@_ACT_SIZE];
unsigned long next_us;

void setup() {
  Serial.begin(115200);
  while (@name@_selftest() != 0) {
    Serial.println("self-test failed: do not fly");
    delay(1000);
  }
  @name@_reset(&state);  // again whenever the policy takes up control
  next_us = micros();
}

void loop() {
  if ((long)(micros() - next_us) < 0) return;
  next_us += @NAME@_PERIOD_US;
  if ((long)(micros() - next_us) >= 0) next_us = micros() + @NAME@_PERIOD_US;  // late: what was missed is not caught up

  // Yours: fill obs from the state estimate, in the order, units and frames of @name@.h.
  const int status = @name@_step(&state, obs, act);
  if (status == 2) {
    return;  // An input is not finite: hand over to a fallback controller, yours. act is for one vehicle, level and at rest.
  }
  // Yours: act to motor commands.
}
