// SPDX-License-Identifier: Apache-2.0
//
// All of DSSM's C++ API.
#pragma once

#include <dssm/clock.hpp>
#include <dssm/describe.hpp>
#include <dssm/error.hpp>
#include <dssm/executor.hpp>
#include <dssm/interpolate.hpp>
#include <dssm/pconnector.hpp>
#include <dssm/playback_clock.hpp>
#include <dssm/reader.hpp>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <dssm/sample_collector.hpp>
#include <dssm/sample_or.hpp>
#include <dssm/session.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <dssm/typed_reads.hpp>
#include <dssm/writer.hpp>
