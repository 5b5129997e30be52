"""Pictures by matplotlib: ROC curves, p-values, success, curves of studies, visibility of bands. Extra `plot`."""

from jaxmark.evaluation.pictures.detections import p_values as p_values
from jaxmark.evaluation.pictures.detections import roc as roc
from jaxmark.evaluation.pictures.detections import success as success
from jaxmark.evaluation.pictures.studies import curves as curves
from jaxmark.evaluation.pictures.visibility import band_visibility as band_visibility
