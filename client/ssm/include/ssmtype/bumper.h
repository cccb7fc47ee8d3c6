/* SPDX-License-Identifier: Apache-2.0
 *
 * Sample type of a bumper switch, as SSM ships it.
 */
#ifndef DSSM_SSMTYPE_BUMPER_H
#define DSSM_SSMTYPE_BUMPER_H

typedef struct {
  int state;
  double time;
} Bumper;

#endif
