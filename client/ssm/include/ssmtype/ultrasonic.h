/* SPDX-License-Identifier: Apache-2.0
 *
 * Sample type of four ultrasonic range finders, as SSM ships it.
 */
#ifndef DSSM_SSMTYPE_ULTRASONIC_H
#define DSSM_SSMTYPE_ULTRASONIC_H

typedef struct {
  double front;
  double back;
  double left;
  double right;
  double time;
} Ultrasonic;

#endif
