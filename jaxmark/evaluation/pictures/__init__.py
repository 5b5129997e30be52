"""Pictures of readings by matplotlib: ROC curves, p-values, success and the curves of studies. Extra `plot`."""

from jaxmark.evaluation.pictures.detections import p_values as p_values
from jaxmark.evaluation.pictures.detections import roc as roc
from jaxmark.evaluation.pictures.detections import success as success
from jaxmark.evaluation.pictures.studies import curves as curves
